"""An FMU that asks to end the simulation ends the run there, whatever its version, process, coupling and solver.

The FMU is y' = u from y = 0, so that with u = 1 its output is its time. It ends at `last`.
"""

import numpy as np
import pytest

from loopwright.blocks import Constant, Gain, Integrator
from loopwright.diagrams import Coupling, Diagram, subsystem
from loopwright.fmus import Fmu, FmuError, FmuRuntimeError, StepOptions
from support.eventful import eventful_fmu
from support.small_fmus import small_fmu, values

_BODY = """
typedef struct { double t, y, u, last; bool ended; } instance;
static bool go(instance *c, double t, double h) {
    bool end = t + h >= c->last - 1e-12; if (end && t < c->last) h = c->last - t;
    if (end && t >= c->last) h = 0;
    c->y += h * c->u; c->t = t + h; c->ended = end; return end; }
"""
_SOURCES = {
    "fmi3": """
int fmi3DoStep(void *p, double t, double h, bool f, bool *e, bool *stop, bool *early, double *last) {
    instance *c = p; if (c->ended) return 3;
    *e = false; *stop = go(c, t, h); *last = c->t; *early = c->t < t + h - 1e-12; return 0; }
int fmi3GetFMUState(void *p, void **s) { if (!*s) *s = malloc(sizeof(instance)); memcpy(*s, p, sizeof(instance)); return 0; }
int fmi3SetFMUState(void *p, void *s) { memcpy(p, s, sizeof(instance)); return 0; }
int fmi3FreeFMUState(void *p, void **s) { free(*s); *s = 0; return 0; }
int fmi3SerializedFMUStateSize(void *p, void *s, size_t *n) { *n = sizeof(instance); return 0; }
int fmi3SerializeFMUState(void *p, void *s, unsigned char *b, size_t n) { memcpy(b, s, n); return 0; }
int fmi3DeserializeFMUState(void *p, const unsigned char *b, size_t n, void **s) {
    *s = malloc(n); memcpy(*s, b, n); return 0; }
""",
    "fmi2": """
int fmi2DoStep(void *p, double t, double h, int f) { instance *c = p; return c->ended ? 3 : go(c, t, h) ? 2 : 0; }
int fmi2GetBooleanStatus(void *p, int kind, int *v) { *v = ((instance *)p)->ended; return kind == 3 ? 0 : 2; }
int fmi2GetRealStatus(void *p, int kind, double *v) { *v = ((instance *)p)->t; return kind == 2 ? 0 : 2; }
""",
    "fmi1": """
int fmi1DoStep(void *p, double t, double h, char fresh) { instance *c = p; return c->ended ? 3 : go(c, t, h) ? 2 : 0; }
int fmi1GetBooleanStatus(void *p, int kind, char *v) { *v = ((instance *)p)->ended; return kind == 3 ? 0 : 2; }
int fmi1GetRealStatus(void *p, int kind, double *v) { *v = ((instance *)p)->t; return kind == 2 ? 0 : 2; }
""",
}
_REAL = {"fmi3": "Float64", "fmi2": "Real", "fmi1": "Real"}
_ABLE = {"fmi3": 'canGetAndSetFMUState="true" canSerializeFMUState="true"', "fmi2": "", "fmi1": ""}


def _scalar(fmi, name, reference, causality, start=""):
    start = f' start="{start}"' if start else ""
    if fmi == "fmi3":
        return f'<Float64 name="{name}" valueReference="{reference}" causality="{causality}"{start}/>'
    cause = f'causality="{causality}"'
    if causality == "parameter":  # FMI 1.0 has no such causality
        cause = 'variability="parameter"' if fmi == "fmi1" else f'{cause} variability="fixed"'
    return f'<ScalarVariable name="{name}" valueReference="{reference}" {cause}><Real{start}/></ScalarVariable>'


def _describe(fmi):
    scalars = (("y", 1, "output", ""), ("u", 2, "input", "0"), ("last", 3, "parameter", "1"))
    variables = f"<ModelVariables>{''.join(_scalar(fmi, *each) for each in scalars)}</ModelVariables>"
    able = f'canHandleVariableCommunicationStepSize="true" {_ABLE[fmi]}'
    if fmi == "fmi1":
        return f"""{variables}<Implementation><CoSimulation_StandAlone><Capabilities {able}/>
            </CoSimulation_StandAlone></Implementation>"""
    outputs = '<Output valueReference="1"/>' if fmi == "fmi3" else '<Outputs><Unknown index="1"/></Outputs>'
    return f'<CoSimulation modelIdentifier="small" {able}/>{variables}<ModelStructure>{outputs}</ModelStructure>'


@pytest.fixture(scope="module")
def files(cache, tmp_path_factory):
    folder = tmp_path_factory.mktemp("ends")
    made = {}
    for fmi, source in _SOURCES.items():
        real = _REAL[fmi]
        gets = values(fmi, "Get", real, "double", {1: "c->y", 2: "c->u", 3: "c->last"})
        sets = values(fmi, "Set", real, "double", {2: "c->u", 3: "c->last"})
        made[fmi] = small_fmu(folder, fmi, _BODY + source + gets + sets, _describe(fmi))
    return made


def driven(file, last, **options):
    plant = Fmu(file, name="plant", start={"last": last}, **options)
    return Diagram("d", plant(u=Constant(value=1.0)))


def check_end(run, t, at=None):
    assert (run.stopped.t, run.stopped.block) == (pytest.approx(t, abs=1e-14), "plant")
    assert run.t[-1] == run.stopped.t
    np.testing.assert_allclose(run["plant.y"], run.t, rtol=0, atol=1e-13)
    assert run.final_state is None
    told = [m for m in run.messages if "asks to end the simulation" in m]
    assert len(told) == 1
    assert f"t = {t if at is None else at:.9g} s (terminateSimulation)" in told[0]


# --- where it ends ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compiled", [False, True], ids=["interpreted", "compiled"])
@pytest.mark.parametrize("isolate", [False, True])
@pytest.mark.parametrize("fmi", ["fmi3", "fmi2", "fmi1"])
@pytest.mark.drawn(1)
def test_a_run_ends_where_its_fmu_asks_for_that(files, fmi, isolate, compiled):
    options = {"step": 0.1, "compile": compiled, "progress": False}
    run = driven(files[fmi], 0.5, isolate=isolate).simulate(1.0, **options)
    assert run.tier == ("compiled" if compiled else "interpreted")
    check_end(run, 0.5)
    assert len(run.t) == 6
    within = driven(files[fmi], 0.53, isolate=isolate).simulate(1.0, **options)
    check_end(within, 0.53)
    assert len(within.t) == 7  # the FMU's outputs at its own end


@pytest.mark.parametrize("last", [0.5, 0.53])
@pytest.mark.parametrize(("isolate", "compiled"), [(False, False), (True, False), (False, True)])
@pytest.mark.drawn(2)
def test_with_a_solver_it_ends_at_a_communication_point(files, last, isolate, compiled):
    plant = Fmu(files["fmi3"], name="plant", start={"last": last}, isolate=isolate)
    wired = plant(u=Constant(value=1.0))
    run = Diagram("d", Integrator(name="area")(wired.y)).simulate(
        1.0, step=0.1, rtol=1e-8, compile=compiled, progress=False
    )
    assert not (compiled and any("Interpreted" in m for m in run.messages)), run.messages
    check_end(run, 0.5, at=last)
    np.testing.assert_allclose(run.t, np.arange(6) * 0.1, rtol=0, atol=1e-15)  # none of the step that was given up
    held = np.concatenate([[0.0], np.cumsum(0.1 * run["plant.y"][:-1])])  # outputs are held over a step
    np.testing.assert_allclose(run["area.y"], held, rtol=0, atol=1e-12)
    assert any("last communication point" in m for m in run.messages) == (last == 0.53)


@pytest.mark.parametrize("compiled", [False, True])
def test_the_last_of_every_few_samples_is_none_of_the_step_that_was_given_up(files, compiled):
    plant = Fmu(files["fmi3"], name="plant", start={"last": 0.53}, isolate=False)
    area = Integrator(name="area")(plant(u=Constant(value=1.0)).y)
    run = Diagram("d", area).simulate(1.0, step=0.1, rtol=1e-8, every=4, compile=compiled, progress=False)
    np.testing.assert_allclose(run.t, [0.0, 0.4], rtol=0, atol=1e-15)  # that of 0.5 s was not kept, and is gone
    np.testing.assert_allclose(run["area.y"], [0.0, 0.06], rtol=0, atol=1e-12)


@pytest.mark.parametrize("last", [0.5, 0.53])
@pytest.mark.parametrize("options", [StepOptions(early_return=True), StepOptions(rollback=True)])
def test_with_the_options_of_a_step_it_ends_there_too(files, options, last):
    check_end(driven(files["fmi3"], last, stepping=options).simulate(1.0, step=0.1, progress=False), last)


@pytest.mark.parametrize("last", [0.5, 0.53])
def test_a_compiled_run_ends_there_too(files, last):
    diagram = driven(files["fmi3"], last, isolate=False)
    run = diagram.simulate(1.0, step=0.1, compile=True, progress=False)
    assert not any("Interpreted" in m for m in run.messages)
    check_end(run, last)


@pytest.mark.parametrize(
    ("coupling", "ends"),
    [("jacobi", 0.5), ("gauss_seidel", 0.5), ("iterated", 0.5), (Coupling(scheme="jacobi", error=1e-6), 0.5)],
    ids=["jacobi", "gauss_seidel", "iterated", "adaptive"],
)
@pytest.mark.parametrize("compiled", [False, "auto", True])
@pytest.mark.drawn(4)
def test_coupled_fmus_end_the_run_together(files, coupling, ends, compiled):
    def other(last):
        plant = Fmu(files["fmi3"], name="plant", start={"last": last})
        follower = Fmu(files["fmi3"], name="follower", start={"last": 9.0})
        return Diagram("d", follower(u=plant(u=Constant(value=1.0)).y))

    options = {"step": 0.1, "coupling": coupling, "compile": compiled, "progress": False}
    run = other(0.5).simulate(1.0, **options)
    check_end(run, ends)
    assert len(run["follower.y"]) == 6
    within = other(0.53).simulate(1.0, **options)
    assert within.stopped.block == "plant"
    assert within.stopped.t == within.t[-1] == pytest.approx(0.53 if coupling == "jacobi" else 0.5, abs=1e-14)
    np.testing.assert_allclose(within["plant.y"], within.t, rtol=0, atol=1e-13)


def test_an_fmu_with_communication_points_of_its_own_ends_at_one(files):
    plant = Fmu(files["fmi3"], name="plant", start={"last": 0.5}, stepping=StepOptions(communication_step=0.25))

    @subsystem(sample_time=0.05)
    def clock(u):
        return Gain(gain=1.0)(u)

    run = Diagram("d", plant(u=Constant(value=1.0)), clock(Constant(value=1.0))).simulate(1.0, progress=False)
    assert (run.stopped.t, run.stopped.block) == (0.5, "plant")
    np.testing.assert_allclose(run["plant.y"], np.floor(run.t / 0.25 + 1e-9) * 0.25, rtol=0, atol=1e-14)


def test_ticks_beside_longer_steps_have_gone_on_and_the_message_has_each_time(files):
    plant = Fmu(files["fmi3"], name="plant", start={"last": 0.5034}, stepping=StepOptions(communication_step=0.01))

    @subsystem(sample_time=0.001)
    def clock(u):
        return Gain(gain=1.0)(u)

    run = Diagram("d", plant(u=Constant(value=1.0)), clock(Constant(value=1.0))).simulate(1.0, progress=False)
    assert run.stopped.t == run.t[-1] == pytest.approx(0.509, abs=1e-14)
    np.testing.assert_allclose(run["plant.y"], np.floor(run.t / 0.01 + 1e-9) * 0.01, rtol=0, atol=1e-13)
    (told,) = [m for m in run.messages if "asks to end" in m]
    assert "at t = 0.5034 s" in told
    assert "its last communication point is t = 0.5 s, and the run ends at t = 0.509 s" in told


# --- after the end ------------------------------------------------------------------------------------------------------


def test_nothing_goes_on_from_the_end_but_from_before(files):
    with driven(files["fmi3"], 0.5).simulation(step=0.1) as simulation:
        simulation.advance(0.3)
        kept = simulation.save()
        simulation.advance(0.7)
        assert simulation.t == 0.5
        assert not simulation.can_save
        with pytest.raises(
            FmuError, match=r"^plant: the FMU has asked to end .* at t = 0\.5 s.*Save the run at an earlier"
        ):
            simulation.save()
        simulation.restore(kept)
        assert simulation.stopped is None
        assert simulation.can_save
        simulation.advance(0.1)
        assert simulation.run()["plant.y"][-1] == pytest.approx(0.4)


def test_linear_models_and_differences_refuse_it(files):
    plant = Fmu(files["fmi3"], name="plant", start={"last": 0.05})
    with pytest.raises(FmuError, match=r"^plant: it ends its step from t = 0 s by 0\.1 s early, or asks to end"):
        plant.step_difference(0.1)
    diagram = Diagram("d", plant(u=Constant(value=0.0)))
    with pytest.raises(FmuError, match="asks to end the simulation"):
        diagram.linearize(step=0.1, inputs=["plant.u"], outputs=["plant.y"])


def test_without_a_run_it_is_an_error_that_tells_the_time(files):
    ending = Fmu(files["fmi3"], name="plant", start={"last": 0.53})
    with ending.instantiate(["u"], None) as one:
        one.bind(np.ones(1), np.zeros(1))
        one.begin()
        with pytest.raises(FmuRuntimeError, match=r"asks to end .* at 0\.53 s, in the step from t = 0\.5 s") as error:
            one.step(0.5, 0.1)
    assert error.value.ends_at == pytest.approx(0.53)
    assert one.ends_run


# --- in Event Mode --------------------------------------------------------------------------------------------------------

_EVENTS = """
typedef struct { double t, y, u, last; int mode; } instance;
void *fmi3InstantiateCoSimulation() { instance *c = calloc(1, sizeof(instance)); c->mode = 1; return c; }
int fmi3EnterEventMode(void *p) { ((instance *)p)->mode = 1; return 0; }
int fmi3EnterStepMode(void *p) { ((instance *)p)->mode = 2; return 0; }
int fmi3UpdateDiscreteStates(void *p, bool *more, bool *stop, bool *nominals, bool *v, bool *defined, double *next) {
    instance *c = p; *more = *nominals = *v = false; *stop = c->t >= c->last - 1e-12;
    *defined = !*stop; *next = c->last; return c->mode == 1 ? 0 : 3; }
int fmi3DoStep(void *p, double t, double h, bool f, bool *e, bool *stop, bool *early, double *last) {
    instance *c = p; if (c->mode != 2) return 3;
    *e = *stop = *early = false; c->y += h * c->u; *last = c->t = t + h; return 0; }
"""


@pytest.mark.parametrize("in_c", [False, True], ids=["interpreted", "compiled"])
@pytest.mark.parametrize("isolate", [False, True])
@pytest.mark.parametrize(("last", "samples"), [(0.0, 1), (0.5, 6), (0.53, 7)])
def test_an_end_in_event_mode_ends_the_run_there(cache, tmp_path, last, samples, isolate, in_c):
    gets = values("fmi3", "Get", "Float64", "double", {1: "c->y", 2: "c->u", 3: "c->last"})
    sets = values("fmi3", "Set", "Float64", "double", {2: "c->u", 3: "c->last"})
    about = _describe("fmi3").replace("<CoSimulation ", '<CoSimulation hasEventMode="true" ')
    about = about.replace('canGetAndSetFMUState="true" canSerializeFMUState="true"', "")
    file = small_fmu(tmp_path, "fmi3", _EVENTS + gets + sets, about)
    run = driven(file, last, isolate=isolate, stepping=StepOptions(event_mode=True)).simulate(
        1.0, step=0.1, compile=in_c, progress=False
    )
    check_end(run, last)
    assert len(run.t) == samples


@pytest.mark.parametrize("in_c", [False, True], ids=["interpreted", "compiled"])
def test_an_end_in_event_mode_beside_continuous_states(cache, tmp_path, in_c):
    gets = values("fmi3", "Get", "Float64", "double", {1: "c->y", 2: "c->u", 3: "c->last"})
    sets = values("fmi3", "Set", "Float64", "double", {2: "c->u", 3: "c->last"})
    about = _describe("fmi3").replace("<CoSimulation ", '<CoSimulation hasEventMode="true" ')
    about = about.replace('canGetAndSetFMUState="true" canSerializeFMUState="true"', "")
    file = small_fmu(tmp_path, "fmi3", _EVENTS + gets + sets, about)
    plant = Fmu(file, name="plant", start={"last": 0.5}, stepping=StepOptions(event_mode=True))
    made = Diagram("d", plant(u=Constant(value=1.0)), Integrator(name="sum")(plant.y))
    run = made.simulate(1.0, step=0.1, compile=in_c, progress=False)
    assert run.tier == ("compiled" if in_c else "interpreted")
    check_end(run, 0.5)
    np.testing.assert_allclose(run.t, np.arange(6) * 0.1, atol=1e-14)
    np.testing.assert_allclose(run["sum.y"][-1], 0.1 * np.sum(run["plant.y"][:-1]), rtol=1e-9)  # y is held over steps


def test_a_linear_model_at_an_end_in_model_exchange_is_refused(cache, tmp_path):
    file = eventful_fmu(tmp_path, 3)
    plant = Fmu(file, name="plant", start={"last": -1}, interface="model_exchange")
    wired = plant(u=Constant(value=0.5), n=Constant(value=0.0))
    with pytest.raises(
        FmuError, match=r"^plant: the FMU asks to end the simulation \(terminateSimulation\) at t = 0 s"
    ):
        Diagram("d", wired).linearize(outputs="plant.x")


@pytest.mark.parametrize("isolate", [False, True])
@pytest.mark.parametrize("last", [0.5, 0.53])
@pytest.mark.parametrize("fmi", ["fmi2", "fmi1"])
@pytest.mark.drawn(3)
def test_an_end_in_a_part_of_a_discarded_step_ends_the_run_there(cache, tmp_path, fmi, last, isolate):
    """It discards steps above 0.03 s, and says that it has not gone on; parts of them are taken until the end."""
    real, source = _REAL[fmi], _SOURCES[fmi].replace("c->ended ? 3 :", "c->ended ? 3 : h > 0.03 ? 2 :")
    gets = values(fmi, "Get", real, "double", {1: "c->y", 2: "c->u", 3: "c->last"})
    sets = values(fmi, "Set", real, "double", {2: "c->u", 3: "c->last"})
    file = small_fmu(tmp_path, fmi, _BODY + source + gets + sets, _describe(fmi))
    run = driven(file, last, isolate=isolate).simulate(1.0, step=0.1, progress=False)
    check_end(run, last)
    assert any("discarded a step" in m for m in run.messages)
