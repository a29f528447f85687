"""Inputs out of the range of an FMU's description, in a coupling that tries values: accepted ones count alone.

a is y = r − 3 u, b is y = u, both at once, and b feeds back to a: with r = t the loop has y = t / 4, while the first
pass over a step puts a.y beyond that by three quarters of the step.
"""

import numpy as np
import pytest

from loopwright.blocks import Constant, Ramp
from loopwright.diagrams import Coupling, Diagram
from loopwright.fmus import Fmu, FmuRuntimeError
from support.small_fmus import small_fmu, values

SOURCE = (
    """
typedef struct { double t, r, u, gain; } instance;
int fmi3DoStep(void *p, double t, double h, bool f, bool *e, bool *stop, bool *early, double *last) {
    *e = *stop = *early = false; *last = ((instance *)p)->t = t + h; return 0; }
int fmi3GetFMUState(void *p, void **s) { if (!*s) *s = malloc(sizeof(instance)); memcpy(*s, p, sizeof(instance)); return 0; }
int fmi3SetFMUState(void *p, void *s) { memcpy(p, s, sizeof(instance)); return 0; }
int fmi3FreeFMUState(void *p, void **s) { free(*s); *s = 0; return 0; }
"""
    + values("fmi3", "Get", "Float64", "double", {1: "c->r + c->gain * c->u", 2: "c->r", 3: "c->u", 4: "c->gain"})
    + values("fmi3", "Set", "Float64", "double", {2: "c->r", 3: "c->u", 4: "c->gain"})
)
MODEL = """<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true" canGetAndSetFMUState="true"/>
<ModelVariables><Float64 name="y" valueReference="1" causality="output"/>
<Float64 name="r" valueReference="2" causality="input" start="0"/>
<Float64 name="u" valueReference="3" causality="input" start="0" max="{most}"/>
<Float64 name="gain" valueReference="4" causality="parameter" variability="fixed" start="1"/></ModelVariables>
<ModelStructure><Output valueReference="1" dependencies="2 3"/></ModelStructure>"""


@pytest.fixture(scope="module")
def folder(cache, tmp_path_factory):
    return tmp_path_factory.mktemp("ranges")


def loop(folder, most, isolate):
    file = small_fmu(folder, "fmi3", SOURCE, MODEL.format(most=most))
    a = Fmu(file, name="a", start={"gain": -3.0}, isolate=isolate)
    b = Fmu(file, name="b", start={"gain": 1.0}, isolate=isolate)
    return Diagram("loop", a(r=Ramp(slope=1.0), u=b(r=Constant(value=0.0), u=a.y).y))


@pytest.mark.parametrize("isolate", [False, True])
def test_a_value_that_iteration_tries_is_not_refused(folder, isolate):
    run = loop(folder, 0.2501, isolate).simulate(1.0, step=0.1, coupling="iterated", progress=False)
    np.testing.assert_allclose(run["a.y"], run.t / 4, rtol=0, atol=1e-8)


@pytest.mark.parametrize("isolate", [False, True])
def test_an_accepted_value_is_refused_with_its_time_and_range(folder, isolate):
    with pytest.raises(
        FmuRuntimeError, match=r"^a\.u, t = 0\.8 s: found 0\.2125; expected at most 0\.2\. Limit"
    ) as error:
        loop(folder, 0.2, isolate).simulate(1.0, step=0.1, coupling="iterated", progress=False)
    assert error.value.run.t[-1] == 0.8


def test_adaptive_steps_refuse_accepted_values_alone(folder):
    coupling = Coupling(scheme="iterated", error=1e-3)
    run = loop(folder, 0.2501, False).simulate(1.0, step=0.1, coupling=coupling, progress=False)
    np.testing.assert_allclose(run["a.y"], run.t / 4, rtol=0, atol=1e-8)
    with pytest.raises(FmuRuntimeError, match=r"^a\.u, t = 0\.8 s: found 0\.206"):
        loop(folder, 0.2, False).simulate(1.0, step=0.1, coupling=coupling, progress=False)
