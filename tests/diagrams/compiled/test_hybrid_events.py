"""Events in compiled runs: closed forms, and the same words as interpreted where they pile up."""

import numpy as np
import pytest

from loopwright.blocks import (
    Block,
    Clock,
    Compare,
    Constant,
    Event,
    Function,
    Gain,
    Integrator,
    Relay,
    SimulationError,
    State,
    StopCondition,
    TransferFunction,
)
from loopwright.diagrams import Diagram, subsystem

QUIET = {"progress": False}
G = 9.81


class Ball(Block):
    """A ball that keeps a part of its speed at each impact."""

    restitution: float = 1.0
    h = State(start=1.0, output=True)
    v = State(output=True)
    impact = Event("falling")

    def derivative(self, t, x, u):
        return x.v, -G + 0.0 * t

    def indicators(self, t, x, u):
        return x.h

    def jump(self, t, x, u, fired):
        return 0.0 * x.h, -self.restitution * x.v


def both(made, duration, **options):
    interpreted = made.simulate(duration, **QUIET, **options)
    compiled = made.simulate(duration, compile=True, **QUIET, **options)
    assert not any(message.startswith("Interpreted") for message in compiled.messages)
    assert [(e.block, e.event) for e in compiled.events] == [(e.block, e.event) for e in interpreted.events]
    return interpreted, compiled


@pytest.mark.parametrize(("solver", "bound"), [("RK45", 1e-9), ("RK23", 1e-9), ("DOP853", 1e-9), ("rk4", 1e-12)])
def test_impacts_of_a_ball_come_at_their_times_without_python(solver, bound):
    made = Diagram("ball", Ball())
    _, run = both(made, 10.0, step=0.05, solver=solver, rtol=1e-9, atol=1e-12)
    first = np.sqrt(2.0 / G)
    expected = first * (1.0 + 2.0 * np.arange(len(run.events)))
    assert len(run.events) == 11
    assert np.max(np.abs(expected - [e.t for e in run.events])) < 30 * bound
    speed = np.sqrt(2.0 * G)
    assert all(e.before["v"] == pytest.approx(-speed, rel=1e-8) and e.after["v"] == -e.before["v"] for e in run.events)
    assert max(abs(e.before["h"]) for e in run.events) < 1e-12
    energy = G * run["ball.h"] + 0.5 * run["ball.v"] ** 2
    assert np.max(np.abs(energy / G - 1.0)) < 100 * bound


def test_a_thermostat_switches_at_the_times_of_its_exponentials():
    room = TransferFunction(numerator=1.0, denominator=[2.0, 1.0], name="room")
    relay = Relay(on_point=1.0, off_point=0.9)
    made = Diagram("thermostat", room(Gain(gain=-1.5)(relay(room.y)) + 1.5))
    interpreted, run = both(made, 60.0, step=0.1, rtol=1e-9, atol=1e-12)
    times = np.array([e.t for e in run.events])
    cooling, heating = 2.0 * np.log(1.0 / 0.9), 2.0 * np.log(0.6 / 0.5)
    expected = 2.0 * np.log(3.0) + np.cumsum([0.0, *([cooling, heating] * len(times))])[: len(times)]
    usual = np.max(np.abs(np.array([e.t for e in interpreted.events]) - expected))
    assert np.max(np.abs(times - expected)) < min(1.05 * usual, 1e-6)


def test_a_carrier_that_only_just_crosses_its_level_is_followed_there():
    """Between two instants that are looked at, sin passes 1 − 1e-9 twice, 9e-5 rad apart."""
    carrier = Function(lambda t: np.sin(t), name="carrier")(Clock())
    made = Diagram("dips", Integrator(name="time")(Compare(">", name="above")(carrier, 1.0 - 1e-9)))
    _, run = both(made, 20.0, step=0.5)
    width = 2.0 * np.arccos(1.0 - 1e-9)
    assert run["time.y"][-1] == pytest.approx(3.0 * width, rel=1e-6)
    assert len(run.events) == 6


def test_an_event_within_rounding_of_a_tick_is_seen_by_its_subsystem():
    @subsystem(sample_time=0.1, name="box")
    def box(u):
        return Gain(gain=1.0)(u)

    made = Diagram("d", box(Compare(">=", name="late")(Integrator(name="x")(Constant(value=1.0)), 0.3)))
    interpreted, run = both(made, 1.0)
    assert np.array_equal(run["box.gain.y"], interpreted["box.gain.y"])
    assert np.array_equal(run["box.gain.y"], np.arange(11) >= 3)


@pytest.mark.parametrize(("states", "expected"), [("held", 3.0), ("reset", 1.0)])
def test_a_subsystem_that_is_enabled_between_ticks_integrates_while_it_is_open(states, expected):
    @subsystem(enabled=states, name="gate")
    def gate():
        return Integrator(name="x")(Constant(value=1.0))

    wave = Function(lambda t: np.sin(np.pi * t), name="wave")(Clock())
    _, run = both(Diagram("d", gate(enable=Compare(">")(wave, 0.0))), 5.5, step=0.01)
    assert run["gate.x.y"][-1] == pytest.approx(expected, rel=1e-9)


def test_a_stop_condition_between_ticks_ends_it_at_its_event():
    made = Diagram("d", StopCondition(name="stop")(Compare(">")(Integrator(name="x")(Constant(value=1.0)), 0.333)))
    _, run = both(made, 1.0, step=0.1)
    assert run.stopped.t == run.t[-1] == pytest.approx(0.333, abs=1e-12)


def test_impacts_that_pile_up_are_the_same_error_at_the_same_time():
    runs = []
    for form in (False, True):
        with pytest.raises(SimulationError, match="Zeno") as caught:
            Diagram("ball", Ball(restitution=0.5)).simulate(5.0, step=0.05, compile=form, **QUIET)
        runs.append(caught.value)
    assert runs[0].block == runs[1].block
    assert runs[1].t == pytest.approx(runs[0].t, abs=1e-7)
    assert runs[1].t == pytest.approx(3.0 * np.sqrt(2.0 / G), abs=1e-4)
    assert len(runs[1].run.events) == pytest.approx(len(runs[0].run.events), abs=1)


def test_an_ideal_relay_chatters_with_the_same_words():
    x = Integrator(name="x", initial_value=0.105)
    made = Diagram("d", x(Gain(gain=-1.0)(Relay(on_point=0.0, off_point=0.0, off_value=-1.0, name="r")(x.y))))
    errors = []
    for form in (False, True):
        with pytest.raises(SimulationError, match="chatters") as caught:
            made.simulate(1.0, step=0.01, compile=form, **QUIET)
        errors.append(caught.value)
    assert errors[0].block == errors[1].block
    assert errors[1].t == pytest.approx(0.105, abs=1e-6)


def test_a_sliding_mode_of_a_fixed_step_goes_on_and_is_told():
    x = Integrator(name="x", initial_value=0.105)
    made = Diagram("d", x(Gain(gain=-1.0)(Relay(on_point=0.0, off_point=0.0, off_value=-1.0, name="r")(x.y))))
    run = made.simulate(0.5, step=0.01, solver="rk4", compile=True, **QUIET)
    assert [m for m in run.messages if "sliding mode" in m]
    assert np.max(np.abs(run["x.y"] - np.maximum(0.105 - run.t, 0.0))) < 0.011


def test_a_run_with_events_goes_on_is_saved_and_branches_between_both_forms():
    made = Diagram("ball", Ball())
    whole = made.simulate(6.0, step=0.05, **QUIET)
    first = np.sqrt(2.0 / G)
    since = (whole.t + first) % (2.0 * first) - first  # the last time at its greatest height, or the next one
    assert np.max(np.abs(whole["ball.h"] - (1.0 - 0.5 * G * since**2))) < 1e-6
    with made.simulation(step=0.05, compile=True) as simulation:
        simulation.advance(1.0)
        simulation.advance(2.0)
        half = simulation.save()
        simulation.advance(3.0)
        assert np.max(np.abs(simulation.run().data - whole.data)) < 1e-6
        simulation.restore(half)
        simulation.advance(3.0)
        assert np.max(np.abs(simulation.run().data - whole.data[60:])) < 1e-6
    assert np.max(np.abs(made.simulate(3.0, step=0.05, start=half, **QUIET).data - whole.data[60:])) < 1e-6


def test_thousands_of_events_need_no_python():
    """A valve with a narrow hysteresis about a slope: a saw tooth of known frequency."""
    x = Integrator(name="x", initial_value=0.0)
    relay = Relay(on_point=1e-4, off_point=-1e-4, on_value=-1.0, off_value=1.0, name="valve")
    made = Diagram("saw", x(relay(x.y)))
    run = made.simulate(2.0, step=0.01, compile=True, **QUIET)
    assert len(run.events) == 10000
    assert np.max(np.abs(np.diff([e.t for e in run.events]) - 2e-4)) < 1e-12
