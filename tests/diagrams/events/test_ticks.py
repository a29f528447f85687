"""An event within a few ulps of a tick belongs to the tick: a sampled subsystem sees it there."""

import numpy as np
import pytest

from loopwright.blocks import (
    Block,
    Clock,
    Compare,
    Constant,
    Counter,
    Event,
    Gain,
    Integrator,
    PulseTrain,
    Relay,
    State,
    Step,
)
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
@pytest.mark.slow
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


class Saw(Block):
    """It rises by 1 in a second, and goes back to 0 where it comes to 1."""

    y = State(start=0.0, output=True)
    full = Event("rising")

    def derivative(self, t, x, u):
        return 1.0 + 0.0 * x.y

    def indicators(self, t, x, u):
        return x.y - 1.0

    def jump(self, t, x, u, fired):
        return 0.0 * x.y


@pytest.mark.parametrize("compiled", ["auto", True])
@pytest.mark.parametrize("solver", ["auto", "rk4", "RK45", "Radau", "LSODA", "CVODE_Adams", "BDF"])
@pytest.mark.drawn(6)
def test_a_sample_of_a_diagram_in_continuous_time_sees_an_event_that_belongs_to_it(solver, compiled):
    """y = t modulo 1, from the right, at 1, 2, … 6 s."""
    run = Diagram("d", Saw(name="saw")).simulate(6.0, step=0.5, solver=solver, compile=compiled, progress=False)
    np.testing.assert_allclose(run["saw.y"], run.t % 1.0, rtol=0.0, atol=1e-12)


@pytest.mark.both_tiers
def test_an_event_at_a_tick_is_seen_there_beside_one_that_a_source_makes():
    """At 0.3 s a source jumps, and x = t reaches a threshold up to rounding: a sampled subsystem sees both."""
    count = Counter(name="count")(Step(times=0.3, values=1.0))
    compare = Compare(">", name="c")(ramp(), 0.3)

    @subsystem(sample_time=0.1)
    def both(first, second):
        return Gain(gain=1.0, name="f")(first).named("counted"), Gain(gain=1.0, name="g")(second).named("seen")

    run = Diagram("d", *both(count, compare)).simulate(0.6, progress=False)
    assert run["counted"].tolist() == [0, 0, 0, 1, 1, 1, 1]
    assert run["seen"].tolist() == [0, 0, 0, 1, 1, 1, 1]


@pytest.mark.both_tiers
@pytest.mark.parametrize("solver", ["RK45", "Radau"])
def test_a_step_that_ends_a_few_roundings_before_a_jump_of_a_source_does_not_see_it(solver):
    """A signal that falls through a relay's upper level makes no rise; sums of 1/800 s end just before 0.02 k s."""
    for k in range(13, 20):
        relay = Relay(on_point=0.2, off_point=-0.2, name="r")(Step(times=k / 50, values=0.1, initial_value=0.3))
        edges = Integrator(name="i")(PulseTrain(period=0.07, duty=0.75))  # steps of full length begin behind them
        run = Diagram("d", relay, edges).simulate(0.5, step=0.5, max_step=1 / 800, solver=solver, progress=False)
        assert run.events == (), k
