"""A run whose end is between two ticks ends there, with a last sample."""

from itertools import pairwise

import numpy as np
import pytest

from loopwright.blocks import Clock, Compare, Gain, OptionError, Sine, StopCondition, UnitDelay
from loopwright.diagrams import Diagram, experiments, subsystem
from support.hybrid_blocks import Falls, Lag, counting
from support.tanks import CALLS, Tank


@pytest.mark.drawn(2)
@pytest.mark.parametrize("solver", ["auto", "DOP853", "BDF", "rk4"])
@pytest.mark.parametrize("duration", [0.25, 0.05, 1 / 3, np.pi])
def test_the_last_sample_is_at_the_end(solver, duration):
    run = Diagram("d", Falls(name="f")).simulate(
        duration, step=0.1, solver=solver, rtol=1e-9, atol=1e-12, progress=False
    )
    grid = [k / 10 for k in range(int(duration * 10) + 1)]
    assert run.t.tolist() == [*grid, duration]
    assert run["f.h"] == pytest.approx(1.0 - 9.81 / 2 * run.t**2, rel=1e-8)
    assert run.final_state is None


def test_nothing_sampled_acts_at_the_end():
    count = counting(0.1, name="c")().named("n")
    run = Diagram("d", count).simulate(0.25, progress=False)
    assert run.t.tolist() == [0.0, 0.1, 0.2, 0.25]
    assert run["n"].tolist() == [1, 2, 3, 3]

    @subsystem(sample_time=0.1)
    def held(u):
        return Gain(gain=1.0, name="g")(u).named("y")

    lag = Lag(name="lag")
    run = Diagram("d", lag(held(Clock()))).simulate(0.25, rtol=1e-10, atol=1e-12, progress=False)
    x, t = 0.0, [0.0, 0.1, 0.2, 0.25]
    for a, b in pairwise(t):  # x' = a − x while a is held
        x = a + (x - a) * np.exp(-(b - a))
    assert run["y"].tolist() == [0.0, 0.1, 0.2, 0.2]
    assert run["lag.y"][-1] == pytest.approx(x, abs=1e-10)


def test_a_sampled_diagram_alone_and_every_second_sample():
    @subsystem(sample_time=0.1)
    def box(u):
        return UnitDelay(initial_value=7.0, name="z")(u).named("y")

    run = Diagram("d", box(Sine(frequency=1.0))).simulate(0.55, every=2, progress=False)
    assert run.t.tolist() == [0.0, 0.2, 0.4, 0.55]
    assert run["y"][-1] == pytest.approx(np.sin(2 * np.pi * 0.4))


@pytest.mark.parametrize("compiled", [False, "auto", True])
def test_signals_in_continuous_time_are_those_of_the_end_without_any_states(compiled):
    @subsystem(sample_time=0.02)
    def box(u):
        return Gain(gain=1.0, name="g")(u).named("y")

    outside = Gain(gain=2.0, name="outside")(Clock(name="clock"))
    run = Diagram("d", box(Clock(name="k")), outside).simulate(2.39, compile=compiled, progress=False)
    assert run.t[-2:].tolist() == [2.38, 2.39]
    assert run["y"][-2:].tolist() == [2.38, 2.38]
    assert run["clock.y"][-2:].tolist() == [2.38, 2.39]
    assert run["outside.y"][-2:].tolist() == [4.76, 4.78]


def test_an_fmu_steps_to_the_end():
    whole = experiments.path_following().diagram.simulate(0.0100, progress=False)
    part = experiments.path_following().diagram.simulate(0.0095, progress=False)
    assert part.t[-1] == 0.0095
    assert np.array_equal(part.data[:-1], whole.data[:-1])
    (p0, p1), (v0, v1) = whole["plant.position"][-2:], whole["plant.velocity"][-2:]
    middle = 0.5 * (p0 + p1) + 1e-3 / 8 * (v0 - v1)  # Hermite's cubic; the forces are held
    assert part["plant.position"][-1] == pytest.approx(middle, abs=1e-9)


@pytest.mark.one_tier  # it counts calls
@pytest.mark.parametrize("continuous", [False, True])
@pytest.mark.parametrize("end", [0.53, 0.58])  # the last tick of the base before it: 0.5, and 0.55, where nothing acts
def test_a_plant_waits_for_the_end_where_the_last_tick_is_none_of_its_own(continuous, end):
    """The level of a tank, y' = −y held over 0.15 s, which a tick of another subsystem at 0.5 s doesn't renew."""

    @subsystem(sample_time=0.15)
    def controller(level):
        return Gain(gain=-1.0, name="gain")(level)

    class Bent(Tank):
        variable_step = True

    tank = Bent(area=1.0, level=1.0, name="tank")
    more = [Lag(name="lag")(tank.y)] if continuous else []
    CALLS.clear()
    run = Diagram("d", tank(u=controller(tank.y)), counting(0.1, name="c")(), *more).simulate(
        end, progress=False, rtol=1e-10, atol=1e-12
    )
    assert np.allclose([*sum(CALLS[:-1], ())], [0.0, 0.15, 0.15, 0.15, 0.3, 0.15, 0.45, end - 0.45], atol=1e-15)
    assert run.t.tolist() == [0.0, 0.1, 0.15, 0.2, 0.3, 0.4, 0.45, 0.5, end]
    assert run["tank.y"][-3:] == pytest.approx([0.85**3, 0.85**3, 0.85**3 * (1.0 - (end - 0.45))], rel=1e-14)


def test_a_stop_condition_before_the_end_and_at_it():
    def stopping(at):
        return Diagram("d", StopCondition(name="stop")(Compare(">", name="c")(Clock(), at)), Falls(name="f"))

    early = stopping(0.22).simulate(0.25, step=0.1, progress=False)
    assert early.stopped.t == early.t[-1] == pytest.approx(0.22, abs=1e-12)
    assert stopping(0.3).simulate(0.25, step=0.1, progress=False).stopped is None


def test_it_can_not_go_on_from_there():
    with Diagram("d", Falls(name="f")).simulation(step=0.1) as simulation:
        simulation.advance(0.2)
        simulation.advance(0.05)
        assert simulation.t == 0.25
        assert not simulation.can_save
        with pytest.raises(OptionError, match=r"has ended at t = 0\.25 s, between two ticks"):
            simulation.advance(0.05)
        with pytest.raises(OptionError, match="between two ticks, and is not saved"):
            simulation.save()
        assert simulation.run().t.tolist() == [0.0, 0.1, 0.2, 0.25]
