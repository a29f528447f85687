"""Event Mode, clocks, early return, discarded steps, slopes of inputs, and the options of a step, against hand calculation."""

import re

import numpy as np
import pytest

from loopwright.blocks import Block, Constant, Gain, OptionError, Output, ParameterError, Ramp, Sine
from loopwright.diagrams import Diagram
from loopwright.diagrams.compiled.plants_called_back import PythonSteps
from loopwright.fmus import Fmu, FmuRuntimeError, StepOptions
from loopwright.fmus.isolation.fmu_process import ChildProcess
from support.careful_fmus import (
    BETWEEN,
    BETWEEN_MODEL,
    CLOCK,
    EVENTS,
    INTEGRATOR,
    INTEGRATOR_MODEL,
    MODEL,
    OUTPUTS,
    ROLLS_BACK,
    SIMPLE2,
)
from support.small_fmus import small_fmu, values


class Level(Block):
    """2 from 0.3 s on, 1 before it."""

    y = Output()

    def output(self, t, x, u):
        return np.where(t < 0.299, 1.0, 2.0)


@pytest.fixture(scope="module")
def folder(cache, tmp_path_factory):
    return tmp_path_factory.mktemp("stepping")


@pytest.fixture(scope="module")
def events(folder):
    return small_fmu(folder, "fmi3", EVENTS, MODEL.format(clock="", outputs=OUTPUTS, variable="true"))


@pytest.fixture(scope="module")
def clocked(folder):
    return small_fmu(
        folder, "fmi3", EVENTS, MODEL.format(clock=CLOCK, outputs=OUTPUTS, variable="true"), name="clocked"
    )


def simulate(plant, duration=1.0, step=0.1, **inputs):
    wires = {"u": Constant(value=1.0), "level": Level()} | inputs
    return Diagram("d", plant(**wires)).simulate(duration, step=step, progress=False)


# --- Event Mode ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [0.1, 0.07, 1.0])
def test_an_event_within_a_step_is_handled_where_it_is(events, step):
    plant = Fmu(events, name="plant", stepping=StepOptions(event_mode=True))
    run = simulate(plant, 14 * 0.07 if step == 0.07 else 1.0, step)
    assert run["plant.x"] == pytest.approx(np.where(run.t < 0.5, run.t, 1.0 - run.t), abs=1e-12)
    assert run["plant.timed"][-1] == 1.0


def test_without_event_mode_the_fmu_is_stepped_as_before(events):
    run = simulate(Fmu(events, name="plant"), level=Constant(value=0.0))
    assert run["plant.x"] == pytest.approx(run.t, abs=1e-12)
    assert run["plant.timed"][-1] == 0.0


def test_discrete_inputs_are_set_in_event_mode(events):
    run = simulate(Fmu(events, name="plant", stepping=StepOptions(event_mode=True)))
    assert run["plant.seen"].tolist() == [*[1.0] * 4, *[2.0] * 7]  # seen one step after they are set


def test_periodic_clocks_tick_at_their_times_whatever_the_step(clocked):
    for step in (0.1, 0.25):
        run = simulate(Fmu(clocked, name="plant"), step=step)
        assert run["plant.beats"].tolist() == [1.0, *[np.floor((t - 1e-9) / 0.15) + 1.0 for t in run.t[1:]]]


def test_a_linearized_step_has_the_events_of_a_run(clocked):
    """A step of 0.3 s from t = 0: the clock ticks at 0 and at 0.15 s, the time event is at 0.25 s, and x = 0.3 u."""
    model = Fmu(clocked, name="plant").step_difference(0.3, inputs={"u": 1.0})
    y = dict(zip(model.outputs, model.y0, strict=True))
    assert (y["beats"], y["timed"]) == (2.0, 1.0)
    assert y["x"] == pytest.approx(0.3, abs=1e-12)
    row, column = model.outputs.index("x"), model.inputs.index("u")
    assert model.D[row, column] == pytest.approx(0.3, abs=1e-9)


@pytest.mark.parametrize(("step", "every"), [(0.1, 1e-12), (1e-7, 1e-12), (0.1, 2e-5), (1e-3, 1e-5)])
@pytest.mark.drawn(2)
def test_a_clock_that_ticks_very_often_is_told_with_its_rate(folder, step, every):
    clock = CLOCK.replace("0.15", f"{every:g}")
    file = small_fmu(
        folder, "fmi3", EVENTS, MODEL.format(clock=clock, outputs=OUTPUTS, variable="true"), name=f"often{every:g}"
    )
    diagram = Diagram("d", Fmu(file, name="plant", isolate=False)(u=Constant(value=0.0), level=Constant(value=0.0)))
    if every == 1e-12:
        with pytest.raises(FmuRuntimeError, match=r"^plant, t = .*events \(its clock beat\) every 1e-12 s, about 1e\+"):
            diagram.simulate(step, step=step, progress=False)
        return
    run = diagram.simulate(step, step=step, progress=False)
    assert run["plant.beats"][-1] == pytest.approx(step / every, abs=1)
    told = [m for m in run.messages if "continues slowly" in m]
    assert len(told) == (step == 0.1)
    assert all("its clock beat) every 2e-05 s, about 5e+03 times in a step of 0.1 s" in m for m in told)


@pytest.fixture(scope="module")
def countdown(folder):
    """From the time event at 0.25 s on, the FMU counts down 0.18 s, once, if its input is positive."""
    clock = CLOCK.replace('"constant" intervalDecimal="0.15"', '"countdown"')
    counts = """
int fmi3GetIntervalDecimal(void *p, const unsigned vr[], size_t n, double v[], int q[]) {
    instance *c = p; bool now = c->mode == 1 && fabs(c->t - 0.25) < 1e-9 && c->u > 0;
    v[0] = 0.18; q[0] = now ? 2 : c->t > 0.25; return 0; }
int fmi3SetClock(void *p, const unsigned vr[], size_t n, const bool v[]) {
    instance *c = p; c->beats++; c->level = c->t; return c->mode == 1 && vr[0] == 8 ? 0 : 3; }
int unused("""
    source = EVENTS.replace("int fmi3SetClock(", counts)
    return small_fmu(
        folder, "fmi3", source, MODEL.format(clock=clock, outputs=OUTPUTS, variable="true"), name="countdown"
    )


def test_a_countdown_clock_ticks_when_the_fmu_says(countdown):
    run = simulate(Fmu(countdown, name="plant"), level=Constant(value=0.0))
    assert run["plant.beats"].tolist() == [0.0] * 5 + [1.0] * 6
    assert run["plant.seen"][-1] == pytest.approx(0.43, abs=1e-12)


def test_a_countdown_of_an_earlier_start_is_over(countdown):
    beats = []
    with Fmu(countdown, name="plant", start={"u": 1.0}).instantiate([], None) as one:
        one.bind(np.zeros(0), np.zeros(6))
        for end in (0.4, 0.8):  # the first one counts down to 0.43 s
            one.begin()
            one.step(0.0, end)
            beats += one.values(["beats"]).tolist()
            one.reset()
            one.initialize(None, values={"u": 0.0})
    assert beats == [0.0, 0.0]


def test_a_tunable_parameter_changes_in_event_mode(folder):
    row = '<Int32 name="level" valueReference="9" causality="parameter" variability="tunable" start="0"/>'
    model = re.sub('<Int32 name="level".*?/>', row, MODEL)
    file = small_fmu(folder, "fmi3", EVENTS, model.format(clock="", outputs=OUTPUTS, variable="true"), name="tunable")
    ports = ["x", "u", "seen", "level"]
    run = simulate(Fmu(file, name="plant", stepping=StepOptions(event_mode=True), ports=ports))
    assert run["plant.seen"].tolist() == [*[1.0] * 4, *[2.0] * 7]


CLOCKED = (
    """
typedef struct { double t, level, seen; int mode, active, sets, beats; } instance;
void *fmi3InstantiateCoSimulation() { instance *c = calloc(1, sizeof(instance)); c->active = 1; return c; }
int fmi3ExitInitializationMode(void *p) { instance *c = p; c->active = 0; c->mode = 1; return 0; }
int fmi3EnterEventMode(void *p) { ((instance *)p)->mode = 1; return 0; }
int fmi3EnterStepMode(void *p) { instance *c = p; c->mode = 2; c->active = 0; return 0; }
int fmi3UpdateDiscreteStates(void *p, bool *more, bool *stop, bool *nominals, bool *v, bool *defined, double *next) {
    instance *c = p; if (c->active) c->seen = c->level; *more = *stop = *nominals = *v = *defined = false; return 0; }
int fmi3SetClock(void *p, const unsigned vr[], size_t n, const bool v[]) {
    instance *c = p; if (c->mode != 1) return 3; c->active = v[0]; c->beats += v[0]; return 0; }
int fmi3DoStep(void *p, double t, double h, bool f, bool *e, bool *stop, bool *early, double *last) {
    instance *c = p; *e = *stop = *early = false; *last = c->t = t + h; return c->mode == 2 ? 0 : 3; }
"""
    + values("fmi3", "Get", "Float64", "double", {1: "c->seen"})
    + values("fmi3", "Get", "Int32", "int32_t", {2: "c->level", 3: "c->beats"})
    + values("fmi3", "Set", "Int32", "int32_t", {2: "if (!c->active) return 3; c->level"})
)
CLOCKED_MODEL = """<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true" hasEventMode="true"/>
<ModelVariables><Float64 name="seen" valueReference="1" causality="output"/>
<Int32 name="level" valueReference="2" causality="input" variability="discrete" start="0" clocks="8"/>
<Int32 name="beats" valueReference="3" causality="output"/>{clock}</ModelVariables>
<ModelStructure><Output valueReference="1"/><Output valueReference="3"/></ModelStructure>"""


class Stairs(Block):
    """0 until 0.3 s, 1 until 0.6 s, then 2."""

    y = Output()

    def output(self, t, x, u):
        return np.where(t < 0.299, 0.0, np.where(t < 0.599, 1.0, 2.0))


@pytest.mark.parametrize("isolate", [False, True])
def test_a_triggered_clock_ticks_where_an_input_that_it_clocks_changes(folder, isolate):
    """The FMU refuses to set the input while its clock does not tick (FMI 3.0: clocked variables)."""
    clock = CLOCK.replace('"constant" intervalDecimal="0.15"', '"triggered"')
    file = small_fmu(folder, "fmi3", CLOCKED, CLOCKED_MODEL.format(clock=clock), name="triggered")
    run = Diagram("d", Fmu(file, name="plant", isolate=isolate)(level=Stairs())).simulate(1.0, step=0.1, progress=False)
    assert run["plant.beats"].tolist() == [*[0.0] * 4, *[1.0] * 3, *[2.0] * 4]
    assert run["plant.seen"].tolist() == [*[0.0] * 4, *[1.0] * 3, *[2.0] * 4]
    assert not any("never tick" in m for m in run.messages)


def test_an_input_of_a_periodic_clock_is_set_at_its_ticks_alone(folder):
    file = small_fmu(folder, "fmi3", CLOCKED, CLOCKED_MODEL.format(clock=CLOCK.replace("0.15", "0.4")), name="periodic")
    run = Diagram("d", Fmu(file, name="plant")(level=Stairs())).simulate(1.0, step=0.1, progress=False)
    assert run["plant.beats"].tolist() == [1.0, *[1.0] * 4, *[2.0] * 4, *[3.0] * 2]
    assert run["plant.seen"].tolist() == [*[0.0] * 5, *[1.0] * 4, *[2.0] * 2]


def test_clocks_that_never_tick_are_told(folder):
    clock = CLOCK.replace('"constant" intervalDecimal="0.15"', '"triggered"')
    file = small_fmu(folder, "fmi3", EVENTS, MODEL.format(clock=clock, outputs=OUTPUTS, variable="true"), name="still")
    run = simulate(Fmu(file, name="plant"), level=Constant(value=0.0))
    assert run["plant.beats"][-1] == 0.0
    text = "plant: the clocks beat (triggered Clock) never tick: a triggered clock ticks where an input that"
    assert any(message.startswith(text) for message in run.messages)
    with pytest.raises(
        ParameterError, match=r"^plant\.ports: found 'beat', a triggered input clock; expected a number"
    ):
        simulate(Fmu(file, name="plant", ports=["beat"]))


def test_a_clock_between_the_steps_of_an_fmu_with_even_steps_is_refused(folder):
    file = small_fmu(folder, "fmi3", EVENTS, MODEL.format(clock=CLOCK, outputs=OUTPUTS, variable="false"), name="even")
    with pytest.raises(FmuRuntimeError, match=r"^plant, t = 0\.1 s: its clock beat ticks at 0\.15 s, between two") as e:
        simulate(Fmu(file, name="plant"))
    assert "Run with step=0.15." in str(e.value)
    assert simulate(Fmu(file, name="plant"), 0.9, 0.15)["plant.beats"][-1] == 6.0


def test_events_that_never_settle_are_an_error(folder):
    endless = EVENTS.replace("*more = c->rounds++ < 2", "*more = true")
    file = small_fmu(folder, "fmi3", endless, MODEL.format(clock="", outputs=OUTPUTS, variable="true"), name="endless")
    with pytest.raises(FmuRuntimeError, match=r"the events don't settle in 100 rounds \(discreteStatesNeedUpdate\)"):
        simulate(Fmu(file, name="plant", stepping=StepOptions(event_mode=True)))


def test_a_next_event_time_that_is_no_number_is_an_error(folder):
    odd = EVENTS.replace("*next = 0.25;", "*next = 0.0 / 0.0;")
    file = small_fmu(folder, "fmi3", odd, MODEL.format(clock="", outputs=OUTPUTS, variable="true"), name="odd")
    with pytest.raises(FmuRuntimeError, match=r"^plant, t = 0 s: .*nextEventTime.* NaN"):
        simulate(Fmu(file, name="plant", stepping=StepOptions(event_mode=True)))


def test_events_and_clocks_are_those_of_a_restored_state(clocked):
    plant = Fmu(clocked, name="plant", start={"level": 0})
    u, y = np.ones(1), np.zeros(6)
    ends = []
    with plant.instantiate(["u"], None) as one:
        one.bind(u, y)
        one.begin()
        for k in range(10):
            if k == 2:
                saved = one.save()  # before the time event, and a tick
            one.step(k * 0.1, 0.1)
        ends.append(y.copy())
        for _ in range(2):
            one.restore(saved)
            for k in range(2, 10):
                one.step(k * 0.1, 0.1)
            ends.append(y.copy())
    assert ends[0].tolist() == pytest.approx([0.0, 0.0, -1.0, 0.9, 7.0, 1.0], abs=1e-12)
    assert np.array_equal(ends[0], ends[1])
    assert np.array_equal(ends[0], ends[2])


def test_a_linear_model_of_a_step_is_that_of_event_mode(clocked):
    plant = Fmu(clocked, name="plant", start={"level": 0})
    D = plant.step_difference(0.1, inputs={"u": 1.0}).D
    assert D[0, 0] == pytest.approx(0.1, rel=1e-9)


# --- early return -------------------------------------------------------------------------------------------------------

STOPS_OFTEN = (
    """
typedef struct { double t; int steps, allowed, stuck; } instance;
void *fmi3InstantiateCoSimulation(const char *n, const char *k, const char *r, bool v, bool l, bool event, bool early) {
    instance *c = calloc(1, sizeof(instance)); c->allowed = early; return c; }
int fmi3DoStep(void *p, double t, double h, bool f, bool *e, bool *stop, bool *early, double *last) {
    instance *c = p; *e = *stop = *early = false; if (fabs(t - c->t) > 1e-12) return 3;
    double way = c->allowed && h > 0.04 ? 0.04 : h; if (STUCK) way = 0;
    *early = way < h; c->t = t + way; c->steps++; *last = c->t; return 0; }
"""
    + values("fmi3", "Get", "Float64", "double", {1: "c->t"})
    + values("fmi3", "Get", "Int32", "int32_t", {2: "c->steps"})
)
SIMPLE = """<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true" {more}/><ModelVariables>
<Float64 name="y" valueReference="1" causality="output"/><Int32 name="steps" valueReference="2" causality="output"/>
</ModelVariables><ModelStructure><Output valueReference="1"/><Output valueReference="2"/></ModelStructure>"""


def test_a_step_goes_on_from_where_it_returned_early(folder):
    file = small_fmu(folder, "fmi3", STOPS_OFTEN.replace("STUCK", "0"), SIMPLE.format(more=""))
    plant = Fmu(file, name="plant", stepping=StepOptions(early_return=True))
    run = Diagram("d", plant()).simulate(0.5, step=0.1, progress=False)
    assert run["plant.y"] == pytest.approx(run.t, abs=1e-15)
    assert run["plant.steps"].tolist() == [0, 3, 6, 9, 12, 15]  # 40, 40 and 20 ms


def test_an_fmu_that_never_goes_on_is_an_error(folder):
    file = small_fmu(folder, "fmi3", STOPS_OFTEN.replace("STUCK", "c->t > 0.25"), SIMPLE.format(more=""))
    plant = Fmu(file, name="plant", stepping=StepOptions(early_return=True))
    with pytest.raises(FmuRuntimeError, match=r"^plant, t = 0\.2 s: its steps returned early at 0\.28 s 101 times"):
        Diagram("d", plant()).simulate(0.5, step=0.1, progress=False)


# --- discarded steps ----------------------------------------------------------------------------------------------------

DISCARDS3 = (
    """
typedef struct { double t; int steps; } instance;
int fmi3DoStep(void *p, double t, double h, bool f, bool *e, bool *stop, bool *early, double *last) {
    instance *c = p; *e = *stop = *early = false; *last = -7;
    if (t + h > 0.2 && h > LONGEST) return 2;
    c->t = *last = t + h; c->steps++; return 0; }
"""
    + values("fmi3", "Get", "Float64", "double", {1: "c->t"})
    + values("fmi3", "Get", "Int32", "int32_t", {2: "c->steps"})
)
DISCARDS2 = (
    """
typedef struct { double t; int steps; } instance;
int fmi2DoStep(void *p, double t, double h, int f) {
    instance *c = p; if (fabs(t - c->t) > 1e-12) return 3;
    if (t + h > 0.2 && h > LONGEST) { c->t = t + LONGEST; return 2; }
    c->t = t + h; c->steps++; return 0; }
int fmi2GetRealStatus(void *p, int kind, double *v) { if (kind != 2 || SILENT) return 3; *v = ((instance *)p)->t; return 0; }
int fmi2GetBooleanStatus(void *p, int kind, int *v) { *v = 0; return 0; }
"""
    + values("fmi2", "Get", "Real", "double", {1: "c->t"})
    + values("fmi2", "Get", "Integer", "int", {2: "c->steps"})
)


def discarding(folder, fmi, longest, *, silent=0, variable="true"):
    if fmi == 3:
        return small_fmu(folder, "fmi3", DISCARDS3.replace("LONGEST", longest), SIMPLE.format(more=""))
    source = DISCARDS2.replace("LONGEST", longest).replace("SILENT", str(silent))
    return small_fmu(folder, "fmi2", source, SIMPLE2.format(variable=variable, more=""))


@pytest.mark.parametrize("fmi", [3, 2])
def test_discarded_steps_are_taken_in_smaller_ones(folder, fmi):
    plant = Fmu(discarding(folder, fmi, "0.03"), name="plant")
    run = Diagram("d", plant()).simulate(0.4, step=0.1, progress=False)
    assert run["plant.y"] == pytest.approx(run.t, abs=1e-15)
    assert run["plant.steps"][2] == 2.0  # whole steps up to 0.2 s
    assert run["plant.steps"][-1] > 4.0
    assert [m for m in run.messages if re.match(r"plant: t = 0\.2 s: the FMU discarded a step of 0\.1 s; it was", m)]


@pytest.mark.parametrize(("fmi", "options"), [(3, {}), (2, {"silent": 1}), (2, {"variable": "false"})])
def test_steps_that_are_always_discarded_end_the_run(folder, fmi, options):
    plant = Fmu(discarding(folder, fmi, "0", **options), name="plant")
    with pytest.raises(FmuRuntimeError, match=rf"t = 0\.2 s: .*was discarded.*fmi{fmi}Discard") as e:
        Diagram("d", plant()).simulate(0.4, step=0.1, progress=False)
    assert e.value.run["plant.steps"].tolist() == [0, 1, 2]  # what was right is kept


@pytest.mark.parametrize("isolate", [True, False])
def test_a_discarded_step_is_taken_again_from_its_start(folder, isolate):
    model = SIMPLE2.format(variable="true", more='canGetAndSetFMUstate="true"')
    file = small_fmu(folder, "fmi2", ROLLS_BACK, model, name="back")
    plant = Fmu(file, name="plant", stepping=StepOptions(rollback=True), isolate=isolate)
    run = Diagram("d", plant()).simulate(0.4, step=0.1, progress=False)
    assert run["plant.y"] == pytest.approx(run.t, abs=1e-12)  # nothing of the discarded step is left
    assert run["plant.steps"].tolist() == [0, 1, 2, 4, 5] or isolate


def test_no_step_is_tried_again_without_retries(folder):
    plant = Fmu(discarding(folder, 3, "0.03"), name="plant", stepping=StepOptions(retries=0))
    with pytest.raises(FmuRuntimeError, match="was discarded"):
        Diagram("d", plant()).simulate(0.4, step=0.1, progress=False)


@pytest.mark.parametrize(("says", "where"), [("-1", "before it began"), ("t + 0.5 * h", "short of its end")])
def test_a_step_that_says_another_end_is_told_once(folder, says, where):
    source = DISCARDS3.replace("if (t + h > 0.2 && h > LONGEST) return 2;", "").replace(
        "*last = t + h", f"t + h; *last = {says}"
    )
    plant = Fmu(small_fmu(folder, "fmi3", source, SIMPLE.format(more="")), name="plant")
    run = Diagram("d", plant()).simulate(0.4, step=0.1, progress=False)
    (message,) = [m for m in run.messages if "lastSuccessfulTime" in m]
    assert message.startswith("plant: t = 0 s: the FMU says that a step of 0.1 s ended at ")
    assert where in message
    assert run["plant.y"] == pytest.approx(run.t, abs=1e-15)


# --- slopes of inputs ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def integrator(folder):
    return small_fmu(folder, "fmi2", INTEGRATOR, INTEGRATOR_MODEL.format(more='canInterpolateInputs="true"'))


@pytest.mark.parametrize(("slopes", "order"), [(False, 1), (True, 2)])
def test_slopes_of_inputs_raise_the_order(integrator, slopes, order):
    plant = Fmu(integrator, name="plant", stepping=StepOptions(input_derivatives=slopes))
    errors = []
    for n in (160, 320):
        wave = Sine(amplitude=1.0, frequency=1.0)
        run = Diagram("d", plant(u=wave)).simulate(1.0, step=1.0 / n, progress=False)
        errors.append(abs(run["plant.x"][n // 4] - (1.0 - np.cos(2.0 * np.pi * run.t[n // 4])) / (2.0 * np.pi)))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.25)


@pytest.mark.parametrize(("slopes", "order", "isolate"), [(False, 1, False), (True, 2, False), (True, 2, True)])
def test_inputs_are_set_within_a_step_of_fmi_3(folder, slopes, order, isolate):
    file = small_fmu(folder, "fmi3", BETWEEN, BETWEEN_MODEL, name="between")
    plant = Fmu(file, name="plant", stepping=StepOptions(input_derivatives=slopes), isolate=isolate)
    errors = []
    for n in (160, 320):
        wave = Gain(gain=np.array([0.25, 0.75]))(Sine(amplitude=1.0, frequency=1.0))
        run = Diagram("d", plant(u=wave)).simulate(1.0, step=1.0 / n, progress=False)
        errors.append(abs(run["plant.x"][n // 4] - (1.0 - np.cos(2.0 * np.pi * run.t[n // 4])) / (2.0 * np.pi)))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.25)


def test_a_fault_within_a_step_is_told_with_its_function(folder):
    source = BETWEEN.replace("if (n != 1 ||", "if ((v[0] > 0.11 && v[0] < 0.12) || n != 1 ||")
    file = small_fmu(folder, "fmi3", source, BETWEEN_MODEL, name="between")
    for isolate in (False, True):
        plant = Fmu(file, name="plant", stepping=StepOptions(input_derivatives=True), isolate=isolate)
        wave = Gain(gain=np.array([0.25, 0.75]))(Ramp(slope=1.0))
        with pytest.raises(
            FmuRuntimeError, match=r"^plant, t = 0\.4 s: setting its inputs within the step by 0\.1 s .*fmi3Error"
        ):
            Diagram("d", plant(u=wave)).simulate(1.0, step=0.1, progress=False)


# --- options ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("time", ["multiplied", "added"])
def test_the_time_that_the_fmu_is_told_is_that_of_the_chosen_arithmetic(events, time):
    plant = Fmu(events, name="plant", stepping=StepOptions(time=time))
    run = simulate(plant, 2.0, 0.1, level=Constant(value=0.0), u=Constant(value=0.01))
    want, t = [], 0.0
    for i in range(20):
        want.append(t if time == "added" else i / 10)
        t += 0.1
    assert run["plant.told"][1:].tolist() == want
    assert want[10] == (0.9999999999999999 if time == "added" else 1.0)


WIDTHS = """
typedef struct { double t, width, ends; } instance;
int fmi3DoStep(void *p, double t, double h, bool final, bool *event, bool *terminate, bool *early, double *reached) {
    instance *c = p; c->width = h; c->t = *reached = t + h; *terminate = c->ends && t + h > c->ends; return 0; }
int fmi3GetFloat64(void *p, const unsigned vr[], size_t n, double v[], size_t nv) {
    instance *c = p; if (c->ends && c->t > c->ends) return 3; v[0] = vr[0] == 1 ? c->width : c->ends; return 0; }
int fmi3SetFloat64(void *p, const unsigned vr[], size_t n, const double v[], size_t nv) {
    ((instance *)p)->ends = v[0]; return 0; }
"""
WIDTHS_MODEL = """<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true"/><ModelVariables>
<Float64 name="width" valueReference="1" causality="output"/>
<Float64 name="ends" valueReference="2" causality="parameter" variability="fixed" start="0"/>
</ModelVariables><ModelStructure><Output valueReference="1"/></ModelStructure>"""


@pytest.mark.parametrize("isolate", [False, True])
@pytest.mark.parametrize("time", ["multiplied", "added"])
def test_a_step_is_told_its_length_to_the_last_bit(folder, time, isolate):
    """Ends of steps that are added up are rounded, and their differences are other numbers than 0.1."""
    file = small_fmu(folder, "fmi3", WIDTHS, WIDTHS_MODEL, name="widths")
    with Fmu(file, name="plant", stepping=StepOptions(time=time), isolate=isolate).instantiate([], None) as one:
        width, found = np.zeros(1), []
        one.bind(np.zeros(0), width)
        one.begin()
        for k in range(20):
            one.step(k / 10, 0.1)
            found.append(float(width[0]))
    assert found == [0.1] * 20
    assert {(k / 10 + 0.1) - k / 10 for k in range(20)} != {0.1}


@pytest.mark.parametrize("isolate", [False, True])
def test_an_fmu_that_has_ended_need_not_give_its_outputs(folder, isolate):
    """The end is what is told, and no function that fails behind it (FMI 3.0, 4.2.1)."""
    file = small_fmu(folder, "fmi3", WIDTHS, WIDTHS_MODEL, name="widths")
    with Fmu(file, name="plant", start={"ends": 0.15}, isolate=isolate).instantiate([], None) as one:
        one.bind(np.zeros(0), np.zeros(1))
        one.begin()
        one.step(0.0, 0.1)
        with pytest.raises(FmuRuntimeError, match=r"asks to end the simulation \(terminateSimulation\) at 0\.2 s"):
            one.step(0.1, 0.1)


TOLD = (
    """
typedef struct { double t, u; } instance;
int fmi2DoStep(void *p, double t, double h, int f) { ((instance *)p)->t = t; return 0; }
"""
    + values("fmi2", "Get", "Real", "double", {1: "c->t"})
    + values("fmi2", "Set", "Real", "double", {2: "c->u"}),
    """<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true"/>
<ModelVariables><ScalarVariable name="told" valueReference="1" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="u" valueReference="2" causality="input" variability="continuous"><Real start="0"/></ScalarVariable>
</ModelVariables><ModelStructure><Outputs><Unknown index="1"/></Outputs></ModelStructure>""",
)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("isolate", [False, True])
def test_added_times_cost_no_requests_of_their_own(cache, tmp_path, monkeypatch, isolate, compiled):
    """In another process a step is one request: nothing else is done but with plain times."""
    asked = []
    original = PythonSteps._take
    monkeypatch.setattr(PythonSteps, "_take", lambda self, *step: asked.append(step) or original(self, *step))
    requests = []
    ask = ChildProcess.request
    monkeypatch.setattr(ChildProcess, "request", lambda self, *a, **k: requests.append(a) or ask(self, *a, **k))
    plant = Fmu(small_fmu(tmp_path, "fmi2", *TOLD), name="plant", isolate=isolate, stepping=StepOptions(time="added"))
    diagram = Diagram("d", plant(Gain(gain=1.0, name="k")(Constant(value=1.0))))
    found = diagram.sweep(
        None,
        2.0,
        samples=[{"k.gain": 1.0}, {"k.gain": 2.0}],
        step=0.1,
        compile=compiled,
        workers=1,
        progress=False,
        signals=["plant.told"],
    )
    want, t = [0.0], 0.0
    for _ in range(20):
        want.append(t)
        t += 0.1
    assert want[11] == 0.9999999999999999
    assert found["plant.told"].tolist() == [want, want]
    run = diagram.simulate(2.0, step=0.1, compile=compiled, progress=False)
    assert run["plant.told"].tolist() == want
    if isolate:
        assert not asked
        assert len(requests) < 60  # in three runs of 20 steps; those of steps are words that are shared


def test_the_tolerance_is_told(events):
    assert simulate(Fmu(events, name="plant"), level=Constant(value=0.0))["plant.tolerance"][-1] == -1.0
    told = Fmu(events, name="plant", stepping=StepOptions(tolerance=1e-7))
    assert simulate(told, level=Constant(value=0.0))["plant.tolerance"][-1] == 1e-7


ENDING = (
    """
typedef struct { double t, end; } instance;
int fmi2SetupExperiment(void *p, int with, double tolerance, double start, int defined, double stop) {
    ((instance *)p)->end = defined ? stop : 0.05; return 0; }
int fmi2DoStep(void *p, double t, double h, int f) {
    instance *c = p; c->t = t + h; return c->t > c->end + 1e-9 ? 3 : 0; }
"""
    + values("fmi2", "Get", "Real", "double", {1: "c->t"}),
    """<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true"/>
<DefaultExperiment startTime="0" stopTime="0.05"/><ModelVariables>
<ScalarVariable name="y" valueReference="1" causality="output"><Real/></ScalarVariable></ModelVariables>
<ModelStructure><Outputs><Unknown index="1"/></Outputs></ModelStructure>""",
)


def test_an_fmu_that_ends_with_its_experiment_is_told_a_later_end(cache, tmp_path):
    file = small_fmu(tmp_path, "fmi2", *ENDING)
    untold = Diagram("d", Fmu(file, name="plant")())
    with pytest.raises(FmuRuntimeError, match=r"Its default experiment ends at 0\.05 s.*stop_time=") as caught:
        untold.simulate(0.1, step=0.01, progress=False)
    assert caught.value.run.t[-1] == pytest.approx(0.05)
    plant = Fmu(file, name="plant", stepping=StepOptions(stop_time=0.1))
    told = Diagram("d", plant())
    run = told.simulate(0.1, step=0.01, progress=False)
    assert run["plant.y"] == pytest.approx(run.t)
    with pytest.raises(FmuRuntimeError, match=r"Its end is 0\.1 s, by stepping=StepOptions\(stop_time"):
        told.simulate(0.2, step=0.01, progress=False)


THROUGH = (
    """
typedef struct { double u, y; int running; } instance;
int fmi2ExitInitializationMode(void *p) { ((instance *)p)->running = 1; return 0; }
int fmi2DoStep(void *p, double t, double h, int f) { instance *c = p; c->y = c->u; return 0; }
"""
    + values("fmi2", "Get", "Real", "double", {1: "c->running ? c->y : c->u"})
    + values("fmi2", "Set", "Real", "double", {2: "if (!c->running) c->y = v[i]; c->u"})
)


@pytest.mark.parametrize(("way", "first"), [("agree", 2.0), ("once", 1.0), ("none", 0.0)])
def test_values_are_exchanged_at_the_start_as_chosen(folder, way, first):
    """The FMU passes its input on at the start, and after a step; u = 1 + y / 2 has the solution 2."""
    file = small_fmu(folder, "fmi2", THROUGH, INTEGRATOR_MODEL.format(more=""), name="through")
    plant = Fmu(file, name="plant")
    diagram = Diagram("d", plant(u=1.0 + 0.5 * plant.x))
    run = diagram.simulate(0.3, step=0.1, progress=False, start_exchange=way)
    want = [first]
    for _ in range(3):
        want.append(1.0 + 0.5 * want[-1])
    assert run["plant.x"] == pytest.approx(want, rel=1e-12)
    with pytest.raises(OptionError, match="start_exchange: found 'twice'; expected 'agree', 'once', 'none'"):
        diagram.simulate(0.3, step=0.1, progress=False, start_exchange="twice")


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"tolerance": 0.0}, r"stepping\.tolerance: found 0\.0; expected a positive number"),
        ({"stop_time": "late"}, r"stepping\.stop_time: found 'late'; expected seconds, positive, or"),
        ({"stop_time": -1.0}, r"stepping\.stop_time: found -1\.0; expected seconds, positive, or None"),
        ({"retries": 1000}, r"stepping\.retries: found 1000; expected an integer from 0 to 50"),
        ({"event_mode": "yes"}, r"stepping\.event_mode: found 'yes'; expected True or False"),
        ({"time": "exact"}, r"stepping\.time: found 'exact'; expected 'multiplied' or 'added'"),
    ],
)
def test_wrong_options_are_refused(options, text):
    with pytest.raises(ParameterError, match=text):
        StepOptions(**options)


@pytest.mark.parametrize(
    ("name", "flag"),
    [
        ("rollback", "canGetAndSetFMUstate"),
        ("event_mode", "hasEventMode"),
        ("early_return", "FMI 3.0"),
        ("input_derivatives", "canInterpolateInputs"),
    ],
)
def test_options_that_the_fmu_does_not_offer_are_refused(folder, name, flag):
    file = discarding(folder, 2, "0.03")
    with pytest.raises(ParameterError, match=rf"^plant\.stepping\.{name}: found True; .*{flag}"):
        Fmu(file, name="plant", stepping=StepOptions(**{name: True}))
    with pytest.raises(ParameterError, match=r"^plant\.stepping: found 3; expected a StepOptions"):
        Fmu(file, name="plant", stepping=3)
