"""FMUs that are set back to the beginning of a step, and are not there."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import Constant, Gain, Step
from loopwright.diagrams import Coupling, Diagram
from loopwright.fmus import Fmu, FmuRuntimeError
from support.small_fmus import small_fmu, values

# y' = u − y over a step with u held; the gain is an output that follows u at once
SOURCE = (
    r"""
typedef struct { double t, u, y; } instance;
int fmi2DoStep(void *p, double t, double h, int no) {
    instance *c = p; c->y = c->u + (c->y - c->u) * exp(-h); c->t = t + h; return 0; }
int fmi2GetFMUstate(void *p, void **s) { if (!*s) *s = malloc(sizeof(instance)); memcpy(*s, p, sizeof(instance));
    return 0; }
int fmi2FreeFMUstate(void *p, void **s) { free(*s); *s = 0; return 0; }
int fmi2SetFMUstate(void *p, void *s) { instance *c = p, *o = s; RESTORE return 0; }
"""
    + values("fmi2", "Get", "Real", "double", {1: "c->y", 2: "2.0 * c->u"})
    + values("fmi2", "Set", "Real", "double", {0: "c->u"})
)
MODEL = """<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true"
canGetAndSetFMUstate="true"/><ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input" variability="continuous"><Real start="0"/>
</ScalarVariable>
<ScalarVariable name="y" valueReference="1" causality="output" variability="continuous"><Real/></ScalarVariable>
<ScalarVariable name="twice" valueReference="2" causality="output" variability="continuous"><Real/></ScalarVariable>
</ModelVariables><ModelStructure><Outputs><Unknown index="2" dependencies=""/><Unknown index="3" dependencies="1"/>
</Outputs></ModelStructure>"""
ADAPTIVE = Coupling(scheme="jacobi", error=1e-4)


@pytest.fixture(scope="module")
def make(tmp_path_factory):
    """Two of the FMU in a loop: a' = 1 − b − a, b' = a − b; ``restore`` is the C code that restores."""

    def build(restore):
        file = small_fmu(tmp_path_factory.mktemp("rollback"), "fmi2", SOURCE.replace("RESTORE", restore), MODEL)
        a, b = Fmu(file, name="a"), Fmu(file, name="b")
        return Diagram("loop", a(u=Gain(gain=-1.0)(b.y) + Constant(value=1.0)), b(u=a.y))

    return build


@pytest.mark.parametrize("coupling", ["iterated", ADAPTIVE], ids=str)
@pytest.mark.parametrize("restore", ["", "c->u = o->u;"], ids=["nothing", "inputs alone"])
@pytest.mark.drawn(2)
def test_an_fmu_that_restores_nothing_is_named(cache, make, restore, coupling):
    with pytest.raises(FmuRuntimeError, match=r"^a\.y, t = 0 s: the FMU does not restore its state.*expected 0,"):
        make(restore).simulate(0.1, step=0.01, progress=False, coupling=coupling)


@pytest.mark.parametrize(("coupling", "off"), [("iterated", 1e-5), (ADAPTIVE, 2e-3)], ids=str)
@pytest.mark.drawn(1)
def test_an_fmu_that_restores_its_state_goes_on(cache, make, coupling, off):
    run = make("*c = *o;").simulate(2.0, step=0.01, progress=False, coupling=coupling)
    A = np.array([[-1.0, -1.0, 1.0], [1.0, -1.0, 0.0], [0.0, 0.0, 0.0]])
    exact = expm(2.0 * A)[:2, 2]
    assert [run["a.y"][-1], run["b.y"][-1]] == pytest.approx(exact, abs=off)


def test_an_output_that_moves_late_is_compared_then(cache, make):
    """Before the step at 0.05 s nothing moves, so that a restore proves nothing."""
    diagram = make("").replace(constant=Step(times=0.05, values=1.0))
    with pytest.raises(FmuRuntimeError, match=r"^a\.\w+, t = 0\.05 s: the FMU does not restore its state"):
        diagram.simulate(0.1, step=0.01, progress=False, coupling=ADAPTIVE)


# A step that is not final is kept as if it were to be rejected, and taken back when the next one begins.
TAKING_BACK = (
    SOURCE.replace("double t, u, y; }", "double t, u, y, before; int open; }")
    .replace(
        "instance *c = p; c->y =",
        "instance *c = p; if (c->open) c->y = c->before;\n    c->before = c->y; c->open = !no; c->y =",
    )
    .replace("RESTORE", "*c = *o; c->open = 0;")
)


def in_a_loop(file):
    """a' = 1 − b − a, b' = a − b, as of `make`."""
    a, b = Fmu(file, name="a"), Fmu(file, name="b")
    return Diagram("loop", a(u=Gain(gain=-1.0)(b.y) + Constant(value=1.0)), b(u=a.y))


@pytest.mark.parametrize("coupling", ["iterated", ADAPTIVE], ids=str)
@pytest.mark.drawn(1)
def test_an_fmu_that_takes_steps_back_by_itself_is_refused_where_steps_may_be_repeated(cache, tmp_path, coupling):
    diagram = in_a_loop(small_fmu(tmp_path, "fmi2", TAKING_BACK, MODEL))
    run = diagram.simulate(2.0, step=0.01, progress=False)
    A = np.array([[-1.0, -1.0, 1.0], [1.0, -1.0, 0.0], [0.0, 0.0, 0.0]])
    assert [run["a.y"][-1], run["b.y"][-1]] == pytest.approx(expm(2.0 * A)[:2, 2], abs=5e-3)
    with pytest.raises(FmuRuntimeError, match=r"^a\.y, t = 0 s: the FMU takes a step back when the next one begins"):
        diagram.simulate(2.0, step=0.01, progress=False, coupling=coupling)


def test_an_fmu_that_arrives_in_one_step_takes_nothing_back(cache, tmp_path):
    """Its output is half its input after a step of any length: a = (1 − b)/2, b = a/2."""
    source = SOURCE.replace("c->y = c->u + (c->y - c->u) * exp(-h)", "c->y = 0.5 * c->u").replace("RESTORE", "*c = *o;")
    run = in_a_loop(small_fmu(tmp_path, "fmi2", source, MODEL)).simulate(
        0.5, step=0.01, progress=False, coupling="iterated"
    )
    assert [run["a.y"][-1], run["b.y"][-1]] == pytest.approx([0.4, 0.2], abs=1e-3)
