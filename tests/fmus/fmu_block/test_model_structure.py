"""FMUs whose descriptions are wrong: dependencies that are left out, states that are not restored."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import Constant, ParameterError
from loopwright.diagrams import AlgebraicLoopError, Diagram
from loopwright.fmus import Fmu, FmuRuntimeError
from support.closed_form import closed_form_fmu
from support.misstated import misstated_fmu

RATE = {
    2: '<Unknown index="4" dependencies="1 2 5"/>',
    3: '<ContinuousStateDerivative valueReference="4" dependencies="1 2 5"/>',
}
OUTPUT = {2: '<Unknown index="6" dependencies="1 2 5"/>', 3: '<Output valueReference="6" dependencies="1 2 5"/>'}


def damped(file):
    """A damper around it: u = 10 − 5 v."""
    plant = Fmu(file, interface="model_exchange", name="plant")
    return Diagram("damped", plant(u=Constant(value=10.0, name="push") - 5.0 * plant.v))


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.drawn(1)
def test_an_input_that_is_left_out_is_named(tmp_path, fmi):
    for given, value in ((RATE, r"der\(v\)"), (OUTPUT, "a")):
        file = misstated_fmu(tmp_path, fmi, [(given[fmi], given[fmi].replace("1 2 5", "1 2"))])
        message = f"says that '{value}' does not depend on 'u'"
        for _ in range(2):  # each time
            with pytest.raises(FmuRuntimeError, match=message) as error:
                damped(file).simulate(0.1, step=0.01, progress=False)
            assert error.value.block == "plant"
        with pytest.raises(FmuRuntimeError, match=message):
            damped(file).linearize(0.0)


@pytest.mark.parametrize("kept", ["5", "2 5"])
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.drawn(1)
def test_states_that_are_left_out_change_neither_a_run_nor_a_linear_model(tmp_path, fmi, kept):
    changes = [(given[fmi], given[fmi].replace("1 2 5", kept)) for given in (RATE, OUTPUT)]
    file = misstated_fmu(tmp_path, fmi, changes)
    follows = [Fmu(file, interface="model_exchange").dependence(of) for of in ("a", "next")]
    assert all(of[known].all() for of in follows for known in ("x", "t"))
    diagram = damped(file)
    A = np.array([[0.0, 1.0], [-100.0, -6.0]])
    start = np.array([0.1, 0.0])  # from its equilibrium at u = 10
    for method in ("RK45", "Radau"):
        run = diagram.simulate(0.5, step=0.01, progress=False, rtol=1e-9, solver=method)
        exact = np.array([expm(A * t) @ -start for t in run.t])
        np.testing.assert_allclose(run["plant.x"], 0.1 + exact[:, 0], atol=1e-7)
        np.testing.assert_allclose(run["plant.a"], exact @ A[1], atol=1e-5)
    linear = diagram.linearize(0.0, inputs="push.y", outputs=("plant.x", "plant.a"))
    np.testing.assert_allclose(linear.A, A, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(linear.C, [[1.0, 0.0], A[1]], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(linear.D, [[0.0], [1.0]], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.drawn(1)
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
@pytest.mark.drawn(1)
def test_a_right_structure_and_one_that_says_nothing_run_as_the_equations_do(tmp_path, fmi):
    M = np.array([[0.0, 1.0, 0.0], [-100.0, -6.0, 10.0], [0.0, 0.0, 0.0]])
    for changes in ((), [(RATE[fmi], RATE[fmi].replace(' dependencies="1 2 5"', ""))]):
        run = damped(misstated_fmu(tmp_path, fmi, changes)).simulate(0.5, step=0.01, progress=False, rtol=1e-10)
        exact = [(expm(M * t) @ [0.0, 0.0, 1.0])[0] for t in run.t]
        np.testing.assert_allclose(run["plant.x"], exact, atol=1e-8)


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_input_that_reads_as_another_value_than_was_set_is_to_be_wired(tmp_path, fmi):
    deaf = ("v[i] = *at(p, r[i]);", "v[i] = r[i] == 5 ? 0.0 : *at(p, r[i]);")
    file = misstated_fmu(tmp_path, fmi, [deaf])
    plant = Fmu(file, interface="co_simulation", name="plant", start={"u": 10.0})
    with pytest.raises(FmuRuntimeError, match=r"set to \[10.0\], but is \[0.0\].*Wire it, with Constant") as error:
        Diagram("alone", plant()).simulate(0.1, step=0.01, progress=False)
    assert (error.value.block, error.value.port) == ("plant", "start.u")
    plant = Fmu(file, interface="co_simulation", name="plant")
    run = Diagram("pushed", plant(u=Constant(value=10.0, name="push"))).simulate(0.5, step=0.01, progress=False)
    exact = [0.1 + (expm(np.array([[0.0, 1.0], [-100.0, -1.0]]) * t) @ [-0.1, 0.0])[0] for t in run.t]
    np.testing.assert_allclose(run["plant.x"], exact, rtol=0, atol=1e-8)


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


# Each value of y2 is another one, at whatever point it is read: as a processor time, that of a coarse clock, a counter
# of calls that falls back, and a random number.
BY_ITSELF = {
    "time": "static double calls; y[1] = 1e-6 * ++calls;",
    "clock": "static int calls; y[1] = 0.25 * (++calls / 7);",
    "toggle": "static int calls; y[1] = ++calls % 2;",
    "random": "static unsigned calls; calls = 1664525u * calls + 1013904223u; y[1] = calls / 4294967296.0;",
}


@pytest.mark.one_tier  # a second run reads other values of y2
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("kind", BY_ITSELF)
@pytest.mark.drawn(2)
def test_an_output_that_changes_by_itself_is_not_the_structures_fault(tmp_path, fmi, kind):
    equations = f"dx[0] = -x[0] + u[0]; y[0] = 2 * x[0]; {BY_ITSELF[kind]}"
    stated = {"dx1": "x1 u1", "y1": "x1", "y2": ""}
    file = closed_form_fmu(tmp_path, fmi, equations, outputs=2, dependencies=stated)
    plant = Fmu(file, interface="model_exchange", name="plant")
    diagram = Diagram("loop", plant(u1=Constant(value=1.0, name="push") - plant.y1))
    for _ in range(2):  # each run says it, though the structure is looked at once
        run = diagram.simulate(1.0, step=0.1, rtol=1e-9, progress=False)
        np.testing.assert_allclose(run["plant.y1"], 2.0 / 3.0 * (1.0 - np.exp(-3.0 * run.t)), atol=1e-7)
        assert [text for text in run.messages if "'y2' changes by itself" in text]
        assert not [text for text in run.messages if "'y1' changes" in text]


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_wrong_structure_beside_an_output_that_changes_by_itself_is_named(tmp_path, fmi):
    equations = f"dx[0] = -x[0] + u[0]; y[0] = 2 * x[0] + 0.1 * u[0]; {BY_ITSELF['clock']}"
    stated = {"dx1": "x1 u1", "y1": "x1", "y2": ""}
    file = closed_form_fmu(tmp_path, fmi, equations, outputs=2, dependencies=stated)
    plant = Fmu(file, interface="model_exchange", name="plant")
    with pytest.raises(FmuRuntimeError, match=r"'y1' does not depend on 'u1'.*dependencies='all'"):
        Diagram("open", plant(u1=Constant(value=1.0, name="push")())).simulate(0.1, step=0.1, progress=False)


@pytest.mark.parametrize("in_c", [False, True], ids=["interpreted", "compiled"])
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.drawn(1)
def test_a_wrong_structure_is_left_aside_where_everything_may_depend_on_everything(tmp_path, fmi, in_c):
    """The structure leaves out the feedthrough, and the way from the state to its derivative."""
    equations = "dx[0] = -x[0] + u[0]; y[0] = 2 * x[0] + 0.5 * u[0];"
    stated = {"dx1": "u1", "y1": "x1"}
    file = closed_form_fmu(tmp_path, fmi, equations, dependencies=stated)
    plant = Fmu(file, interface="model_exchange", name="plant", dependencies="all")
    with pytest.raises(AlgebraicLoopError):  # as the feedthrough counts now
        Diagram("loop", plant(u1=1.0 - plant.y1))
    made = Diagram("loop", plant(u1=Constant(value=1.0, name="push") - plant.y1), loops="solve")
    run = made.simulate(1.0, step=0.1, rtol=1e-9, atol=1e-11, compile=in_c, progress=False)
    a, b = -1.0 - 2.0 / 1.5, 1.0 / 1.5  # u = (1 − 2 x) / 1.5
    x = b / a * (np.exp(a * run.t) - 1.0)
    np.testing.assert_allclose(run["plant.y1"], 2.0 * x + 0.5 * (1.0 - 2.0 * x) / 1.5, atol=1e-7)
    assert made.linearize(0.0).A[0, 0] == pytest.approx(a, abs=1e-8)
    with pytest.raises(ParameterError, match="'declared' or 'all'"):
        plant.replace(dependencies="none")
