"""Stop conditions: the run ends, normally, at the first instant at which one is true."""

import numpy as np
import pytest

from loopwright.blocks import (
    Clock,
    Compare,
    Constant,
    Gain,
    Integrator,
    Requirement,
    SimulationError,
    Step,
    StopCondition,
)
from loopwright.diagrams import Diagram, Run, subsystem
from loopwright.fmus import Fmu, bouncing_ball
from loopwright.types import Stopped
from support.hybrid_blocks import Ball, Falls, Lag, counting


def stop(signal, name="stop"):
    return StopCondition(name=name)(signal)


def test_between_ticks_the_run_ends_at_the_crossing():
    diagram = Diagram("d", stop(Compare(">", name="c")(Clock(), 0.4321)), Falls(name="f"))
    run = diagram.simulate(1.0, step=0.1, progress=False)
    assert isinstance(run.stopped, Stopped)
    assert run.stopped.block == "stop"
    assert run.stopped.t == pytest.approx(0.4321, abs=1e-15)
    assert run.t.tolist() == [0.0, 0.1, 0.2, 0.3, 0.4, run.stopped.t]
    assert run["stop.stopped"].tolist() == [0, 0, 0, 0, 0, 1]
    assert run["f.h"][-1] == pytest.approx(1 - 9.81 * 0.4321**2 / 2, rel=1e-9)


@pytest.mark.slow
def test_in_a_sampled_box_it_ends_at_the_tick():
    @subsystem(sample_time=0.1)
    def box(t):
        return stop(Compare(">")(t, 0.4321))

    for extra in ((), (Falls(name="f"),)):
        run = Diagram("d", box(Clock()), *extra).simulate(1.0, progress=False)
        assert run.stopped == Stopped(0.5, "box.stop")
        assert run.t.tolist() == [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]


def test_a_source_that_steps_at_a_tick_or_between_ends_it_there():
    for at in (0.5, 0.47):
        run = Diagram("d", stop(Step(times=at, values=1.0)), Falls(name="f")).simulate(1.0, step=0.1, progress=False)
        assert run.stopped == Stopped(at, "stop")
        assert run.t[-1] == at


def test_a_held_output_that_becomes_true_at_a_tick_ends_it_at_that_tick():
    @subsystem(sample_time=0.1)
    def box(t):
        return Compare(">=", name="c")(t, 0.3)

    run = Diagram("d", stop(box(Clock())), Falls(name="f")).simulate(1.0, progress=False)
    assert run.stopped == Stopped(0.3, "stop")


def test_the_first_of_several_ends_it():
    one, two = stop(Compare(">")(Clock(), 0.7), "one"), stop(Compare(">")(Clock(), 0.45), "two")
    run = Diagram("d", one, two).simulate(1.0, step=0.1, progress=False)
    assert run.stopped.block == "two"


def test_one_that_is_true_at_the_start_ends_it_there():
    run = Diagram("d", stop(Constant(value=1.0)), Falls(name="f")).simulate(1.0, step=0.1, progress=False)
    assert run.stopped == Stopped(0.0, "stop")
    assert run.t.tolist() == [0.0]


def test_an_event_that_ends_the_run_is_among_its_events():
    run = Diagram("d", stop(Compare("<", name="low")(Ball(name="ball").height, 0.2))).simulate(
        2.0, step=0.1, progress=False
    )
    assert [e.block for e in run.events] == ["low", "stop"]
    assert run.stopped.t == pytest.approx(np.sqrt(2 * 0.8 / 9.81), abs=1e-9)


def test_nothing_steps_beyond_the_stop():
    """The FMU has not made the step in which the condition came true."""
    ball = Fmu(bouncing_ball.build(), name="ball")

    @subsystem(sample_time=0.1)
    def box(h):
        return stop(Compare("<")(h, 0.5))

    run = Diagram("d", box(ball.height)).simulate(2.0, progress=False)
    fall = np.sqrt(2 * 0.5 / 9.81)
    assert run.stopped == Stopped(np.ceil(fall * 10) / 10, "box.stop")
    assert run["ball.height"][-1] == pytest.approx(1 - 9.81 * run.stopped.t**2 / 2, abs=1e-6)
    between = Diagram("d", stop(Compare(">", name="late")(Clock(), 0.33)), Gain(gain=1.0)(ball.height))
    run = between.simulate(2.0, step=0.1, progress=False)
    assert run.t[-1] == pytest.approx(0.33, abs=1e-15)
    assert run["ball.height"][-1] == pytest.approx(1 - 9.81 * 0.3**2 / 2, abs=1e-6)


def test_a_stopped_simulation_does_not_go_on():
    with Diagram("d", stop(Compare(">")(Clock(), 0.25)), counting(0.1)().named("n")).simulation() as simulation:
        simulation.advance(1.0)
        assert simulation.t == simulation.stopped.t == pytest.approx(0.25, abs=1e-15)
        simulation.advance(1.0)
        run = simulation.run()
    assert run.t[-1] == pytest.approx(0.25, abs=1e-15)
    assert run["n"][-1] == 3


def test_the_stop_is_kept_on_disk(tmp_path):
    run = Diagram("d", stop(Compare(">")(Clock(), 0.25))).simulate(1.0, step=0.1, progress=False)
    run.save(tmp_path / "run")
    assert Run.open(tmp_path / "run").stopped == run.stopped
    streamed = Diagram("d", stop(Compare(">")(Clock(), 0.25))).simulate(
        1.0, step=0.1, to=tmp_path / "to", progress=False
    )
    assert streamed.stopped == run.stopped
    assert np.array_equal(streamed.t, run.t)


def test_every_other_sample_keeps_the_instant_of_the_stop():
    run = Diagram("d", stop(Compare(">")(Clock(), 0.25))).simulate(1.0, step=0.01, every=7, progress=False)
    assert run.t[-1] == run.stopped.t
    assert run["stop.stopped"][-1] == 1.0


def test_a_requirement_that_breaks_between_ticks_says_when_and_keeps_the_run():
    lag = Lag(name="lag")(Constant(value=1.0))
    broken = Requirement("stays below a half", upper=0.5, name="limit")(lag)
    with pytest.raises(
        SimulationError, match=r"limit, t = 0\.693.* s: the requirement 'stays below a half' is violated"
    ) as e:
        Diagram("d", broken).simulate(2.0, step=0.1, progress=False)
    assert e.value.run.t[-1] == 0.6


def test_a_requirement_that_is_recorded_lets_the_run_go_on():
    lag = Integrator(name="i")(Constant(value=1.0))
    broken = Requirement("stays below a half", upper=0.5, on_violation="record", name="limit")(lag)
    run = Diagram("d", broken).simulate(1.0, step=0.1, progress=False)
    assert run["limit.violated_at"][-1] == pytest.approx(0.5, abs=1e-14)
    assert run.stopped is None
