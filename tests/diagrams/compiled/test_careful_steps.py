"""Steps of isolated FMUs that are more than calls, under a loop in C: C takes those at which nothing else is to be done.

Events, clocks, rollback, slopes of inputs and texts; numbers by hand, and the bits of interpreted runs.
"""

import numpy as np
import pytest

from loopwright.blocks import Block, Constant, Gain, Output, Ramp, Sine
from loopwright.diagrams import Diagram
from loopwright.fmus import Fmu, FmuRuntimeError, StepOptions
from loopwright.fmus.calls.step import InstanceStep
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
    """1 from 0.3 s on, 0 before it."""

    y = Output()

    def output(self, t, x, u):
        return np.where(t < 0.295, 0.0, 1.0)


@pytest.fixture(scope="module")
def folder(cache, tmp_path_factory):
    return tmp_path_factory.mktemp("careful")


@pytest.fixture(scope="module")
def events(folder):
    return small_fmu(folder, "fmi3", EVENTS, MODEL.format(clock="", outputs=OUTPUTS, variable="true"))


@pytest.fixture
def by_python(monkeypatch):
    """Times in s of the steps that Python has taken or ended."""
    found, end = [], InstanceStep._end

    def noted(self, status):
        found.append(self._t)
        end(self, status)

    monkeypatch.setattr(InstanceStep, "_end", noted)
    return found


def of_second(times):
    """Return the times of the second of two runs that are alike."""
    return times[len(times) // 2 :]


def both(made, duration, step):
    """Run a diagram interpreted and compiled, and return the compiled run; every bit and text is the same."""
    one, two = (made.simulate(duration, step=step, compile=c, progress=False) for c in (False, True))
    assert (one.tier, two.tier) == ("interpreted", "compiled"), two.messages
    assert one.t.tobytes() == two.t.tobytes()
    assert one.data.tobytes() == two.data.tobytes()
    assert one.texts == two.texts
    told = [[m for m in run.messages if not m.startswith(("Compiled", "Interpreted"))] for run in (one, two)]
    assert told[0] == told[1]
    return two


@pytest.mark.parametrize("rollback", [False, True])
def test_only_steps_with_events_are_python_s(events, by_python, rollback):
    """Events are at 0 s, 0.25 s and 0.5 s (within the step from 0.49 s), and where the level jumps."""
    plant = Fmu(events, name="plant", stepping=StepOptions(event_mode=True, rollback=rollback))
    made = Diagram("d", plant(u=Constant(value=1.0), level=Level()))
    run = both(made, 1.0, 0.01)
    assert run["plant.x"] == pytest.approx(np.where(run.t < 0.5, run.t, 1.0 - run.t), abs=1e-12)
    assert run["plant.timed"][-1] == 1.0
    assert run["plant.seen"][[30, 31]].tolist() == [0.0, 1.0]  # seen one step after it is set
    ours = np.unique(np.round(of_second(by_python), 9))
    assert len(ours) <= 6
    assert {0.0, 0.24, 0.3} <= {*ours.tolist()}


def test_clocks_tick_at_their_times(folder, by_python):
    file = small_fmu(
        folder, "fmi3", EVENTS, MODEL.format(clock=CLOCK, outputs=OUTPUTS, variable="true"), name="clocked"
    )
    made = Diagram("d", Fmu(file, name="plant")(u=Constant(value=0.1), level=Constant(value=0.0)))
    run = both(made, 1.0, 0.01)
    assert run["plant.beats"].tolist() == [1.0, *[np.floor((t - 1e-9) / 0.15) + 1.0 for t in run.t[1:]]]
    assert len({*of_second(by_python)}) <= 2 * 7 + 3


def test_a_discarded_step_goes_back_to_the_state_that_c_has_saved(folder, by_python):
    model = SIMPLE2.format(variable="true", more='canGetAndSetFMUstate="true"')
    file = small_fmu(folder, "fmi2", ROLLS_BACK, model, name="back")
    made = Diagram("d", Fmu(file, name="plant", stepping=StepOptions(rollback=True))())
    run = both(made, 0.4, 0.02)
    assert run["plant.y"] == pytest.approx(run.t, abs=1e-12)  # nothing of the discarded step is left
    assert len(of_second(by_python)) == 2  # the first one, and the one that is discarded


def test_slopes_of_inputs_are_told_by_c(folder, by_python):
    """x is the sum of trapezoids over each step, with the slope of the step before: exact for a ramp after the first."""
    more = 'canInterpolateInputs="true"'
    file = small_fmu(folder, "fmi2", INTEGRATOR, INTEGRATOR_MODEL.format(more=more), name="slopes")
    plant = Fmu(file, name="plant", stepping=StepOptions(input_derivatives=True))
    run = both(Diagram("d", plant(u=Ramp(slope=2.0))), 1.0, 0.01)
    assert run["plant.x"] == pytest.approx(run.t**2 - np.where(run.t > 0.0, 1e-4, 0.0), abs=1e-12)
    assert of_second(by_python) == [0.0]
    both(Diagram("d", plant(u=Sine(amplitude=1.0, frequency=1.0))), 0.5, 0.01)


def test_slopes_within_a_step_of_fmi_3_are_told_by_c(folder, by_python):
    file = small_fmu(folder, "fmi3", BETWEEN, BETWEEN_MODEL, name="between")
    plant = Fmu(file, name="plant", stepping=StepOptions(input_derivatives=True))
    ramp = Gain(gain=np.array([0.5, 1.5]))(Ramp(slope=1.0))
    run = both(Diagram("d", plant(u=ramp)), 1.0, 0.01)
    assert run["plant.x"] == pytest.approx(run.t**2 - np.where(run.t > 0.0, 1e-4, 0.0), abs=1e-12)
    assert of_second(by_python) == [0.0]


def test_a_fault_within_a_step_is_told_as_in_an_interpreted_run(folder):
    source = BETWEEN.replace("if (n != 1 ||", "if ((v[0] > 0.11 && v[0] < 0.12) || n != 1 ||")
    file = small_fmu(folder, "fmi3", source, BETWEEN_MODEL, name="between_fault")
    plant = Fmu(file, name="plant", stepping=StepOptions(input_derivatives=True))
    made = Diagram("d", plant(u=Gain(gain=np.array([0.25, 0.75]))(Ramp(slope=1.0))))
    errors = []
    for in_c in (False, True):
        with pytest.raises(FmuRuntimeError, match=r"^plant, t = 0\.4 s: setting its inputs within the step") as caught:
            made.simulate(1.0, step=0.1, compile=in_c, progress=False)
        errors.append(caught.value)
    assert str(errors[0]) == str(errors[1])
    assert errors[0].run.data.tobytes() == errors[1].run.data.tobytes()


TEXTS = """
typedef struct { double t; char mode[32]; int fails; } instance;
const char *name_of(instance *c) { snprintf(c->mode, 32, "phase %d", (int)(4 * c->t + 1e-9)); return c->mode; }
int fmi2DoStep(void *p, double t, double h, int f) { ((instance *)p)->t = t + h; return 0; }
int fmi2GetString(void *p, const unsigned vr[], size_t n, const char *v[]) {
    if (LATE && ((instance *)p)->t > 0.55) return 3; v[0] = name_of(p); return 0; }
""" + values("fmi2", "Get", "Real", "double", {1: "c->t"})
TEXTS_MODEL = """<CoSimulation modelIdentifier="small" canHandleVariableCommunicationStepSize="true"/><ModelVariables>
<ScalarVariable name="y" valueReference="1" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="mode" valueReference="2" causality="output" variability="discrete"><String/></ScalarVariable>
</ModelVariables><ModelStructure><Outputs><Unknown index="1"/><Unknown index="2"/></Outputs></ModelStructure>"""


def test_texts_are_read_where_they_have_changed(folder, by_python):
    file = small_fmu(folder, "fmi2", TEXTS.replace("LATE", "0"), TEXTS_MODEL, name="texts")
    made = Diagram("d", Fmu(file, name="plant")())
    run = both(made, 0.99, 0.01)
    mode = run.texts["plant.mode"]
    assert mode.values == tuple(f"phase {k}" for k in range(4))
    assert mode.t == pytest.approx((0.0, 0.25, 0.5, 0.75))
    assert len(of_second(by_python)) == 4  # the first step, and three changes
    with made.simulation(step=0.01, compile=True) as simulation:
        simulation.advance(0.3)
        simulation.restore(simulation.save()) if simulation.can_save else None
        simulation.advance(0.69)
        assert simulation.run().texts["plant.mode"] == mode


def test_a_text_that_can_not_be_read_ends_the_run_as_interpreted(folder):
    file = small_fmu(folder, "fmi2", TEXTS.replace("LATE", "1"), TEXTS_MODEL, name="late_texts")
    errors = []
    for in_c in (False, True):
        with pytest.raises(FmuRuntimeError, match="reading its texts") as caught:
            Diagram("d", Fmu(file, name="plant")()).simulate(1.0, step=0.1, compile=in_c, progress=False)
        errors.append((str(caught.value), caught.value.t, len(caught.value.run.t)))
    assert errors[0] == errors[1]
