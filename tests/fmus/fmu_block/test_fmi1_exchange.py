"""FMUs of FMI 1.0 in model exchange: a ball with a force, a counter of time events, and strict about its calls."""

import fmpy
import numpy as np
import pytest

from loopwright.blocks import Constant, Gain
from loopwright.diagrams import AlgebraicLoopError, Diagram, subsystem
from loopwright.fmus import Fmu, FmuFileError, doctor
from loopwright.fmus.checks.validation import validate
from loopwright.types import FmuVerdict
from support.small_fmus import small_fmu, values

G, E = 9.81, 0.7
BALL = """
typedef struct { double t, h, v, u, e; int k, steps, ready; } instance;
typedef struct { char converged, names, states, terminate, upcoming; double next; } info;
void *fmi1InstantiateModel() { instance *c = calloc(1, sizeof(instance)); c->h = 1; c->e = 0.7; return c; }
void fmi1FreeModelInstance(void *p) { free(p); }
const char *fmi1GetModelTypesPlatform(void) { return "standard32"; }
int fmi1SetTime(void *p, double t) { ((instance *)p)->t = t; return 0; }
int fmi1Initialize(void *p, char controlled, double tolerance, info *i) {
    instance *c = p; if (c->ready) return 3; c->ready = 1;
    *i = (info){1, 0, 1, 0, 1, 0.25}; return 0; }
int fmi1EventUpdate(void *p, char intermediate, info *i) {
    instance *c = p; if (!c->ready || intermediate) return 3;
    if (c->h <= 0 && c->v < 0) c->v *= -c->e;
    if (c->t >= 0.25 * (c->k + 1)) c->k++;
    *i = (info){1, 0, 1, 0, 1, 0.25 * (c->k + 1)}; return 0; }
int fmi1CompletedIntegratorStep(void *p, char *wanted) { ((instance *)p)->steps++; *wanted = 0; return 0; }
int fmi1SetContinuousStates(void *p, const double x[], size_t n) {
    instance *c = p; if (n != 2) return 3; c->h = x[0]; c->v = x[1]; return 0; }
int fmi1GetContinuousStates(void *p, double x[], size_t n) {
    instance *c = p; if (n != 2) return 3; x[0] = c->h; x[1] = c->v; return 0; }
int fmi1GetNominalContinuousStates(void *p, double x[], size_t n) { x[0] = x[1] = 1; return 0; }
int fmi1GetDerivatives(void *p, double dx[], size_t n) {
    instance *c = p; if (!c->ready) return 3; dx[0] = c->v; dx[1] = c->u - 9.81; return 0; }
int fmi1GetEventIndicators(void *p, double z[], size_t n) { z[0] = ((instance *)p)->h; return n == 1 ? 0 : 3; }
int fmi1SetDebugLogging() { return 0; }
int fmi1GetBoolean() { return 3; }
int fmi1SetBoolean() { return 3; }
int fmi1SetInteger() { return 3; }
int fmi1GetString() { return 3; }
int fmi1SetString() { return 3; }
int fmi1GetStateValueReferences() { return 3; }
int fmi1Terminate(void *p) { return ((instance *)p)->ready ? 0 : 3; }
""" + values("fmi1", "Get", "Real", "double", {1: "c->h", 2: "c->u", 3: "c->e", 4: "c->h + c->u"})
BALL += values("fmi1", "Set", "Real", "double", {1: "c->h", 2: "c->u", 3: "if (c->ready) return 3; c->e"})
BALL += values("fmi1", "Get", "Integer", "int", {5: "c->k", 6: "c->steps"})
MODEL = """<ModelVariables>
<ScalarVariable name="h" valueReference="1" causality="output"><Real start="1" fixed="true"/><DirectDependency/></ScalarVariable>
<ScalarVariable name="u" valueReference="2" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="e" valueReference="3" variability="parameter"><Real start="0.7"/></ScalarVariable>
<ScalarVariable name="y" valueReference="4" causality="output"><Real/>
 <DirectDependency><Name>u</Name></DirectDependency></ScalarVariable>
<ScalarVariable name="k" valueReference="5" causality="output" variability="discrete"><Integer/><DirectDependency/></ScalarVariable>
<ScalarVariable name="steps" valueReference="6" causality="output" variability="discrete"><Integer/><DirectDependency/></ScalarVariable>
</ModelVariables>"""
IMPACT = np.sqrt(2.0 / G)


def bounced(t):
    """Height of the ball up to its second impact."""
    since = t - IMPACT
    return np.where(since < 0.0, 1.0 - 0.5 * G * t**2, E * G * IMPACT * since - 0.5 * G * since**2)


@pytest.fixture(scope="module")
def file(cache, tmp_path_factory):
    return small_fmu(tmp_path_factory.mktemp("fmi1"), "fmi1", BALL, MODEL, name="ball", states=2, indicators=1)


@pytest.mark.parametrize("in_c", [False, True], ids=["interpreted", "compiled"])
@pytest.mark.parametrize("isolate", [False, True])
@pytest.mark.drawn(2)
def test_a_ball_bounces_and_counts_as_in_closed_form(file, tmp_path, isolate, in_c):
    plant = Fmu(file, name="plant", isolate=isolate)
    assert plant.used_interface == "model_exchange"
    made = Diagram("d", plant(u=Constant(value=0.0)))
    run = made.simulate(  # the count of steps is each form's own: a run that is stored is not compared between them
        1.05, step=0.05, rtol=1e-9, atol=1e-12, compile=in_c, to=tmp_path / "run", progress=False
    )
    assert run.tier == ("compiled" if in_c else "interpreted")
    np.testing.assert_allclose(run["plant.h"], bounced(run.t), atol=1e-8)
    np.testing.assert_array_equal(run["plant.k"], np.floor(4.0 * run.t + 1e-12))
    assert [e.t for e in run.events if e.event == "time_event"] == pytest.approx([0.25, 0.5, 0.75, 1.0], abs=1e-12)
    impacts = {e.t for e in run.events if e.event == "indicator[1]"}
    assert sorted(impacts) == pytest.approx([IMPACT] * len(impacts), abs=1e-9)
    assert impacts
    assert run["plant.steps"][-1] > 10


@pytest.mark.parametrize("isolate", [False, True])
def test_it_is_evaluated_in_c(file, isolate):
    """Under a sampled controller: its input jumps at each tick, and Event Mode has no calls of its own in FMI 1.0."""
    plant = Fmu(file, name="plant", isolate=isolate)

    @subsystem(sample_time=0.05)
    def controller(h):
        return 0.5 * h

    made = Diagram("d", plant(u=controller(plant.h)))
    one, two = (made.simulate(0.4, rtol=1e-9, atol=1e-12, compile=c, progress=False) for c in (False, True))
    assert (one.tier, two.tier) == ("interpreted", "compiled"), two.messages
    for name in ("plant.h", "plant.y"):
        np.testing.assert_allclose(one[name], two[name], atol=1e-9)
    np.testing.assert_array_equal(two["plant.k"], np.floor(4.0 * two.t + 1e-12))
    h, v = 1.0, 0.0
    for k in range(8):  # the force is held over each tick
        assert two["plant.h"][k] == pytest.approx(h, abs=1e-9)
        a = 0.5 * h - G
        h, v = h + 0.05 * v + 0.5 * a * 0.05**2, v + 0.05 * a


def test_it_agrees_with_fmpy(file):
    run = Diagram("d", Fmu(file, name="plant")(u=Constant(value=0.0))).simulate(
        1.0, step=0.1, rtol=1e-9, progress=False
    )
    other = fmpy.simulate_fmu(
        str(file), fmi_type="ModelExchange", stop_time=1.0, output_interval=0.1, relative_tolerance=1e-9, output=["h"]
    )
    last = {round(t, 9): h for t, h in zip(other["time"], other["h"], strict=True)}
    ours = {round(t, 9): h for t, h in zip(run.t, run["plant.h"], strict=True)}
    shared = sorted(set(last) & set(ours))
    assert len(shared) >= 10
    np.testing.assert_allclose([ours[t] for t in shared], [last[t] for t in shared], atol=1e-5)


def test_inputs_act_and_only_the_stated_dependencies_make_a_loop(file):
    """With u = -h the height is (1 + g) cos t - g; h is no direct function of u, y is."""
    plant = Fmu(file, name="plant")
    diagram = Diagram("d", plant(u=Gain(gain=-1.0, name="spring")(plant.h)))
    run = diagram.simulate(0.4, step=0.05, rtol=1e-9, atol=1e-12, record=["plant.h", "plant.y"], progress=False)
    exact = (1.0 + G) * np.cos(run.t) - G
    np.testing.assert_allclose(run["plant.h"], exact, atol=1e-8)
    np.testing.assert_allclose(run["plant.y"], 0.0, atol=1e-12)
    with pytest.raises(AlgebraicLoopError, match="depend on each other within one instant"):
        Diagram("d", plant(u=Gain(gain=-1.0, name="spring")(plant.y))).simulate(0.1, progress=False)


def test_parameters_are_set_before_the_initialization(file):
    plant = Fmu(file, name="plant", start={"e": 0.5})
    run = Diagram("d", plant(u=Constant(value=0.0))).simulate(
        0.7, step=0.05, rtol=1e-9, atol=1e-12, record=["plant.h", "plant.k"], progress=False
    )
    since = 0.7 - IMPACT
    assert run["plant.h"][-1] == pytest.approx(0.5 * G * IMPACT * since - 0.5 * G * since**2, abs=1e-8)


def test_what_fmi_1_lacks_is_told(file):
    diagram = Diagram("d", Fmu(file, name="plant")(u=Constant(value=0.0)))
    model = diagram.linearize(inputs="constant.y", outputs="plant.h")
    np.testing.assert_allclose(model.A, [[0.0, 1.0], [0.0, 0.0]], atol=1e-8)
    np.testing.assert_allclose(model.B, [[0.0], [1.0]], atol=1e-8)
    assert diagram.simulate(0.1, progress=False).final_state is None


def test_the_doctor_and_the_validator_try_it(file):
    found = doctor(file)
    assert found.verdict == FmuVerdict.RUNS
    assert any("model exchange evaluated at its start" in done for done in validate(file).done)


def test_a_library_without_the_functions_of_model_exchange_is_refused(tmp_path, cache):
    path = small_fmu(tmp_path, "fmi1", "typedef struct { double t; } instance;", MODEL, states=2, indicators=1)
    with pytest.raises(FmuFileError, match="can't be loaded"):
        Diagram("d", Fmu(path, name="plant", isolate=False)(u=Constant(value=0.0))).simulate(0.1, progress=False)
