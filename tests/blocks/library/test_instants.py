"""Sources act at the tick that their times mean, although times such as 3 * 0.1 are not the number nearest to it."""

import math

import numpy as np
import pytest

from loopwright.blocks import Hold, Integrator, PiecewiseLinear, Pulse, Ramp, Recorded, Step
from loopwright.diagrams import Diagram, subsystem


def _sampled(source, sample_time, duration):
    @subsystem(sample_time=sample_time)
    def box(u):
        return Hold()(u)

    return Diagram("d", box(source).named("y")).simulate(duration)["y"]


@pytest.mark.parametrize("rate", [10, 7, 1000])
def test_data_logged_at_the_rate_of_a_box_plays_one_sample_a_tick(rate):
    T = 0.1 if rate == 10 else 0.007 if rate == 7 else 0.001
    n = 60
    source = Recorded(times=np.linspace(0, (n - 1) * T, n), values=np.arange(float(n)), interpolation="previous")
    assert _sampled(source, T, (n - 1) * T).tolist() == list(range(n))


def test_times_that_are_added_up_play_one_sample_a_tick():
    times = np.arange(0.0, 1.0, 0.1)  # 0.30000000000000004, 0.6000000000000001, …
    assert (times > np.round(times, 1)).any()
    source = Recorded(times=times, values=np.arange(10.0), interpolation="previous")
    assert _sampled(source, 0.1, 0.9).tolist() == list(range(10))


def test_a_step_at_three_times_a_tenth_acts_at_the_tick_at_three_tenths():
    assert _sampled(Step(times=3 * 0.1, values=1.0), 0.1, 0.5).tolist() == [0, 0, 0, 1, 1, 1]


@pytest.mark.parametrize(
    "source",
    [
        Step(times=3 * 0.1, values=1.0),
        Ramp(start_time=3 * 0.1, slope=1.0),
        Pulse(start_time=3 * 0.1, end_time=2.0, amplitude=1.0),
        PiecewiseLinear(times=[3 * 0.1, 1.0], values=[0.0, 1.0]),
        Recorded(times=[0.1, 3 * 0.1], values=[0.0, 1.0], interpolation="previous"),
    ],
    ids=lambda s: type(s).__name__,
)
def test_an_instant_that_counts_as_come_is_not_announced_again(source):
    assert source.next_instant(0.2) == 3 * 0.1
    assert source.next_instant(0.3) > 0.3 + 1e-9  # 3 * 0.1 has come at 0.3
    assert source.next_instant(0.3 * (1 - 1e-13)) == 3 * 0.1


def test_what_is_before_a_change_by_more_than_rounding_is_before_it():
    step = Step(times=1.0, values=1.0)
    held = Recorded(times=[0.0, 1.0], values=[0.0, 1.0], interpolation="previous")
    for t, y in ((1.0 - 1e-14, 0.0), (1.0 - 1e-16, 1.0), (1.0, 1.0)):
        assert step.output(t, None, None) == y
        assert held.output(t, None, None) == y
    assert step.next_instant(1.0) == math.inf


def test_the_area_under_a_step_at_a_rounded_time_is_exact_in_continuous_time():
    i = Integrator(name="i")
    run = Diagram("d", i(Step(times=3 * 0.1, values=1.0))).simulate(1.0, step=0.1)
    assert run["i.y"] == pytest.approx(np.maximum(run.t - 0.3, 0.0), abs=1e-14)
