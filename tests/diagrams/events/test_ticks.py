"""An event within a few ulps of a tick belongs to the tick: a sampled subsystem sees it there."""

import numpy as np
import pytest

from loopwright.blocks import Clock, Compare, Constant, Gain, Integrator
from loopwright.diagrams import Diagram, subsystem
from support.hybrid_blocks import Crossings


@subsystem(sample_time=0.1)
def sampled(u):
    return Gain(gain=1.0, name="g")(u).named("seen")


def ramp(name="x"):
    return Integrator(name=name)(Constant(value=1.0, name=f"{name}_rate")).y


@pytest.mark.parametrize("solver", ["auto", "DOP853", "BDF", "rk4"])
@pytest.mark.parametrize("relation", [">", ">="])
@pytest.mark.parametrize("source", [ramp, lambda: Clock(name="clock").y])
@pytest.mark.drawn(1)
def test_a_threshold_that_is_reached_at_a_tick_is_seen_at_that_tick(solver, relation, source):
    """x = t reaches 0.1 k at tick k, up to rounding of x, of k/10 and of 0.1 k."""
    for k in range(1, 20):
        compare = Compare(relation, name="c")(source(), 0.1 * k)
        run = Diagram("d", sampled(compare)).simulate(2.2, solver=solver, progress=False)
        assert run["seen"].tolist() == [float(j >= k) for j in range(23)], k
        assert [e.t for e in run.events] == pytest.approx([0.1 * k], abs=1e-14)


def test_a_crossing_that_is_later_than_a_tick_is_seen_at_the_next_one():
    for late in (1e-12, 1e-9):
        run = Diagram("d", sampled(Compare(">", name="c")(ramp(), 0.3 + late))).simulate(1.0, progress=False)
        assert run["seen"].tolist() == [float(j >= 4) for j in range(11)]


def test_an_event_at_a_tick_fires_once_and_jumps_on_the_far_side():
    crossings = Crossings(name="c", direction="both")(ramp() - 0.7)
    found = Diagram("d", sampled(crossings.count)).simulate(1.0, rtol=1e-10, progress=False)
    assert [e.t for e in found.events] == pytest.approx([0.7], abs=4 * np.spacing(0.7))
    assert found["seen"].tolist() == [0.0] * 7 + [1.0] * 4
