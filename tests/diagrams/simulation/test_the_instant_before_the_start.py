"""A source that jumps at t = 0 has its value from the left before: whoever looks at changes sees the jump."""

import control
import numpy as np
import pytest

from loopwright.blocks import (
    PID,
    Block,
    Constant,
    Counter,
    EdgeDetector,
    FilteredDerivative,
    Gain,
    Integrator,
    Latch,
    Output,
    PulseTrain,
    Quantizer,
    RateLimiter,
    Recorded,
    Sine,
    SmoothStep,
    Step,
    TransferFunction,
    UnitDelay,
)
from loopwright.diagrams import Diagram, subsystem
from support.hybrid_blocks import TIGHT


def exponential(t):
    """Return the answer of s / (0.1 s + 1) to a step at t = 0."""
    return 10.0 * np.exp(-10.0 * t)


@pytest.mark.drawn(2)
@pytest.mark.parametrize(
    "source",
    [
        Step(times=0.0, values=1.0),
        PulseTrain(period=9.0),
        Recorded(times=[-1.0, 0.0], values=[0.0, 1.0], interpolation="previous"),
    ],
)
def test_a_filtered_derivative_kicks_as_a_transfer_function_does(source):
    slow, ratio = FilteredDerivative(time_constant=0.1), TransferFunction(numerator=[1, 0], denominator=[0.1, 1])
    run = Diagram("d", slow(source), ratio(source)).simulate(0.5, step=0.1, **TIGHT)
    assert run["filtered_derivative.y"] == pytest.approx(exponential(run.t), abs=1e-8)
    assert run["transfer_function.y"] == pytest.approx(exponential(run.t), abs=1e-8)


def test_a_loop_with_derivative_action_answers_a_step_at_zero_as_python_control_has_it():
    """PID with c = 1 around 1 / (s² + s + 1): the issue's 0.183 is the part of the kick."""
    pid, plant = (
        PID(kp=2.0, ki=1.0, kd=0.5, c=1.0, filter_time=0.05),
        TransferFunction(numerator=1.0, denominator=[1, 1, 1], name="plant"),
    )
    u = pid(r=Step(times=0.0, values=1.0), y=plant.y)
    run = Diagram("d", plant(u)).simulate(2.0, step=0.02, **TIGHT)
    s = control.tf("s")
    loop = (2.0 + 1.0 / s + 0.5 * s / (0.05 * s + 1)) / (s**2 + s + 1)
    expected = control.step_response(control.feedback(loop, 1), T=run.t).outputs
    assert run["plant.y"] == pytest.approx(expected, abs=1e-7)


def test_a_sampled_derivative_kicks_at_the_first_tick():
    """With a hold, x_f[k] = 1 − 0.5^k for T = T_f ln 2, so D is 10 · 0.5^k."""

    @subsystem(sample_time=0.1 * np.log(2.0).round(8))
    def controller(u):
        return FilteredDerivative(time_constant=0.1)(u)

    run = Diagram("d", controller(Step(times=0.0, values=1.0))).simulate(5 * 0.069314718, progress=False)
    assert run["filtered_derivative.y"] == pytest.approx(10 * 0.5 ** np.arange(6), rel=1e-6)


def test_a_step_later_or_before_and_a_smooth_signal_start_as_ever():
    for source in (Constant(value=1.0), Step(times=-1.0, values=1.0), Sine(frequency=1.0, bias=3.0)):
        run = Diagram("d", FilteredDerivative(time_constant=0.1)(source)).simulate(0.01, step=0.01, progress=False)
        assert run["filtered_derivative.y"][0] == 0.0
    smooth = SmoothStep(levels=[0.0, 1.0], start_times=[0.0], durations=[1.0])
    run = Diagram("d", FilteredDerivative(time_constant=0.1)(smooth[0])).simulate(0.01, step=0.01, progress=False)
    assert run["filtered_derivative.y"][0] == 0.0


@pytest.mark.parametrize("sample_time", [None, 0.1])
def test_edges_at_zero_count_as_later_ones_do(sample_time):
    @subsystem(sample_time=sample_time)
    def logic(first, later, constant):
        return (
            Counter(name="first")(first),
            Counter(name="later")(later),
            Counter(name="steady")(constant),
        )

    wired = logic(Step(times=0.0, values=1.0), Step(times=0.1, values=1.0), Constant(value=1.0))
    run = Diagram("d", *wired).simulate(0.3, step=0.1, progress=False)
    assert run["first.y"].tolist() == [1, 1, 1, 1]
    assert run["later.y"].tolist() == [0, 1, 1, 1]
    assert run["steady.y"].tolist() == [0, 0, 0, 0]
    assert [(e.t, e.block) for e in run.events] == ([] if sample_time else [(0.0, "logic.first"), (0.1, "logic.later")])


@pytest.mark.parametrize("sample_time", [None, 0.1])
@pytest.mark.parametrize(("first", "hits"), [(0.0, 1), (-1.0, 0)])
def test_a_trigger_that_rises_at_zero_triggers(sample_time, first, hits):
    """At the second rise, at 0.2 s, the delay puts out what the first one has kept."""

    @subsystem(triggered="rising")
    def hit(u):
        return UnitDelay(initial_value=0.0)(u)

    @subsystem(sample_time=sample_time)
    def around(trigger):
        return hit(1.0, trigger=trigger)

    rises = Step(times=[first, 0.1, 0.2], values=[1.0, 0.0, 1.0])
    run = Diagram("d", around(rises)).simulate(0.3, step=0.1, progress=False)
    assert run["unit_delay.y"].tolist() == [0, 0, hits, hits]


@pytest.mark.parametrize("offset", [0.0, 0.05])
def test_a_quantizer_behind_a_sampled_block_sees_the_jump_of_its_source_at_zero(offset):
    """It began from 0.5 · 0.73 = 0.365, and stayed at 0.4 for ever, with −0.33 at its input."""

    @subsystem(sample_time=0.1, offset=offset)
    def controller():
        return Gain(gain=-0.5, name="held")(Step(times=0.0, values=0.66, initial_value=-0.73))

    diagram = Diagram("d", Quantizer(quantum=0.2)(controller()))
    run = diagram.simulate(0.2, step=0.05, progress=False)
    assert run["held.y"] == pytest.approx([-0.33] * 5)
    assert run["quantizer.y"] == pytest.approx([-0.4] * 5)
    assert [(e.t, e.event) for e in run.events] == [(0.0, "down")]


def test_rate_limiters_and_edge_detectors_begin_from_the_left():
    @subsystem(sample_time=0.1)
    def controller(u):
        return RateLimiter(rising=2.0)(u), EdgeDetector()(u)

    run = Diagram("d", *controller(Step(times=0.0, values=1.0))).simulate(0.5, progress=False)
    assert run["rate_limiter.y"] == pytest.approx(np.minimum(0.2 * np.arange(1, 7), 1.0))
    assert run["edge_detector.y"].tolist() == [1, 0, 0, 0, 0, 0]


class Root(Block):
    """A source that is not defined before t = 0, and announces it."""

    y = Output()

    def output(self, t, x, u):
        return 1.0 + np.sqrt(t)

    def next_instant(self, t):
        return 0.0 if t < 0.0 else np.inf


def test_a_source_that_has_no_value_before_zero_begins_there():
    run = Diagram("d", FilteredDerivative(time_constant=0.1)(Root())).simulate(0.01, step=0.01, progress=False)
    assert run["filtered_derivative.y"][0] == 0.0


@pytest.mark.parametrize("sample_time", [None, 0.25])
def test_a_latch_that_is_set_at_the_start_stays_set(sample_time):
    """In continuous time it forgot: the output went back with the input."""

    @subsystem(sample_time=sample_time)
    def logic(set_, reset):
        return Latch()(set_, reset)

    for first in (Step(times=[0.0, 1.0], values=[1.0, 0.0]), Step(times=1.0, values=0.0, initial_value=1.0)):
        reset = Step(times=[1.5, 1.75], values=[1.0, 0.0])
        run = Diagram("d", logic(first, reset)).simulate(2.0, step=0.25, progress=False)
        assert run["latch.y"].tolist() == [1, 1, 1, 1, 1, 1, 0, 0, 0]


def test_a_run_that_goes_on_from_a_saved_state_sees_no_jump_again():
    diagram = Diagram("d", Integrator()(FilteredDerivative(time_constant=0.1)(Step(times=0.0, values=1.0))))
    whole = diagram.simulate(0.4, step=0.1, **TIGHT)
    half = diagram.simulate(0.2, step=0.1, **TIGHT)
    rest = diagram.simulate(0.2, step=0.1, start=half.final_state, **TIGHT)
    assert rest["integrator.y"][-1] == pytest.approx(whole["integrator.y"][-1], abs=1e-8)
