"""FMUs whose descriptions are wrong: dependencies that are left out, states that are not restored."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import Constant, FmuRuntimeError
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu
from tests.support.closed_form import closed_form_fmu
from tests.support.misstated import misstated_fmu

RATE = {
    2: '<Unknown index="4" dependencies="1 2 5"/>',
    3: '<ContinuousStateDerivative valueReference="4" dependencies="1 2 5"/>',
}
OUTPUT = {2: '<Unknown index="6" dependencies="1 2 5"/>', 3: '<Output valueReference="6" dependencies="1 2 5"/>'}


def damped(file):
    """A damper around it: u = 10 − 5 v."""
    plant = Fmu(file, interface="model_exchange", name="plant")
    return Diagram("damped", plant(u=Constant(value=10.0, name="push") - 5.0 * plant.v))


@pytest.mark.parametrize(("fmi", "kept", "left_out"), [(2, "1 2", "u"), (3, "1 2", "u"), (3, "2 5", "x")])
def test_a_dependency_that_is_left_out_is_named(tmp_path, fmi, kept, left_out):
    for given, value in ((RATE, r"der\(v\)"), (OUTPUT, "a")):
        file = misstated_fmu(tmp_path, fmi, [(given[fmi], given[fmi].replace("1 2 5", kept))])
        message = f"says that '{value}' does not depend on '{left_out}'"
        for _ in range(2):  # each time
            with pytest.raises(FmuRuntimeError, match=message) as error:
                damped(file).simulate(0.1, step=0.01, progress=False)
            assert error.value.block == "plant"
        with pytest.raises(FmuRuntimeError, match=message):
            damped(file).linearize(0.0)


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_dependency_that_shows_in_a_mode_alone_is_named_by_a_linear_model_there(tmp_path, fmi):
    equations = "dx[0] = 1.0; y[0] = 4*x[0] + (x[0] > 1.0 ? 5*u[0] : 0.0);"
    file = closed_form_fmu(tmp_path, fmi, equations, dependencies={"y1": "x1", "dx1": ""})
    plant = Fmu(file, interface="model_exchange", name="plant")
    diagram = Diagram("modes", plant(u1=Constant(value=2.0, name="push")()))
    early = diagram.linearize(0.5, inputs="push.y", outputs="plant.y1")
    assert early.C[0, 0] == pytest.approx(4.0, rel=1e-9)
    assert early.D[0, 0] == 0.0
    with pytest.raises(FmuRuntimeError, match="says that 'y1' does not depend on 'u1'") as error:
        diagram.linearize(1.5, inputs="push.y", outputs="plant.y1")
    assert error.value.block == "plant"


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_right_structure_and_one_that_says_nothing_run_as_the_equations_do(tmp_path, fmi):
    M = np.array([[0.0, 1.0, 0.0], [-100.0, -6.0, 10.0], [0.0, 0.0, 0.0]])
    for changes in ((), [(RATE[fmi], RATE[fmi].replace(' dependencies="1 2 5"', ""))]):
        run = damped(misstated_fmu(tmp_path, fmi, changes)).simulate(0.5, step=0.01, progress=False, rtol=1e-10)
        exact = [(expm(M * t) @ [0.0, 0.0, 1.0])[0] for t in run.t]
        np.testing.assert_allclose(run["plant.x"], exact, atol=1e-8)


_KEEPING = """int fmi3GetFMUState(void *p, void **s) { if (!*s) *s = malloc(sizeof(instance)); KEEP return 0; }
int fmi3SetFMUState(void *p, void *s) { RESTORE return 0; }
int fmi3FreeFMUState(void *p, void **s) { free(*s); *s = 0; return 0; }
int fmi3SerializedFMUStateSize(void *p, void *s, size_t *n) { *n = sizeof(instance); return 0; }
int fmi3SerializeFMUState(void *p, void *s, unsigned char *b, size_t n) { memcpy(b, s, n); return 0; }
int fmi3DeserializeFMUState(void *p, unsigned char *b, size_t n, void **s) {
    *s = malloc(sizeof(instance)); memcpy(*s, b, sizeof(instance)); return 0; }
static double *at("""
_FLAG = 'canHandleVariableCommunicationStepSize="true"'


@pytest.mark.parametrize("restores", [True, False])
def test_a_state_that_is_not_restored_is_told_in_the_run_and_in_a_branch(tmp_path, restores):
    copy = ("memcpy(*s, p, sizeof(instance));", "memcpy(p, s, sizeof(instance));") if restores else ("", "")
    source = _KEEPING.replace("KEEP ", copy[0]).replace("RESTORE ", copy[1])
    flags = f'{_FLAG} canGetAndSetFMUState="true" canSerializeFMUState="true"'
    file = misstated_fmu(tmp_path, 3, [("static double *at(", source), (_FLAG, flags)])
    plant = Fmu(file, interface="co_simulation", name="plant")
    diagram = Diagram("pushed", plant(u=Constant(value=10.0, name="push")))
    end = 0.1 - (expm(np.array([[0.0, 1.0], [-100.0, -1.0]])) @ [0.1, 0.0])[0]
    with diagram.simulation(step=0.01) as simulation:
        simulation.advance(0.5)
        half = simulation.save()
        simulation.advance(0.5)
        if restores:
            simulation.restore(half)
            simulation.advance(0.5)
            assert simulation.run()["plant.x"][-1] == pytest.approx(end, abs=1e-8)
        else:
            with pytest.raises(FmuRuntimeError, match="does not restore its state") as error:
                simulation.restore(half)
            assert (error.value.block, error.value.t) == ("plant", 0.5)
    if restores:
        run = diagram.simulate(0.5, start=half, step=0.01, progress=False)
        assert run["plant.x"][-1] == pytest.approx(end, abs=1e-8)
    else:
        with pytest.raises(FmuRuntimeError, match="does not restore its state"):
            diagram.simulate(0.5, start=half, step=0.01, progress=False)
