"""Where events are found, how exactly, and how a run that can't go on because of them ends."""

import re

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from loopwright.blocks import (
    Block,
    Chirp,
    Clock,
    Compare,
    Constant,
    Event,
    Function,
    Gain,
    Input,
    Integrator,
    PiecewiseLinear,
    Relay,
    SimulationError,
    Sine,
    State,
    Step,
    parameter,
)
from loopwright.diagrams import Diagram, NonFiniteError, subsystem
from support.hybrid_blocks import TIGHT, Ball, Crossings, Falls, Lag, Takes

METHODS = ["RK45", "RK23", "DOP853", "Radau", "BDF", "LSODA", "CVODE_BDF", "CVODE_Adams", "auto"]


class Swing(Block):
    """φ̈ = −sin φ; an event where φ crosses a level."""

    level: float = parameter(default=0.0)
    phi = State(start=2.0, output=True)
    rate = State(output=True)
    pass_ = Event("both")

    def derivative(self, t, x, u):
        return x.rate, -np.sin(x.phi)

    def indicators(self, t, x, u):
        return x.phi - self.level

    def jump(self, t, x, u, fired):
        return x.phi, x.rate


@pytest.fixture(scope="module")
def crossings():
    """Instants at which the swing crosses 0.3 within 20 s, from SciPy at 1e-13."""

    def level(t, x):
        return x[0] - 0.3

    found = solve_ivp(
        lambda t, x: [x[1], -np.sin(x[0])], (0, 20), [2.0, 0.0], "DOP853", events=level, rtol=1e-13, atol=1e-14
    )
    return found.t_events[0]


@pytest.mark.drawn(2)
@pytest.mark.parametrize("solver", METHODS)
def test_each_solver_finds_all_crossings_to_its_tolerance(solver, crossings):
    diagram = Diagram("swing", Swing(name="swing", level=0.3))
    errors = []
    for rtol in (1e-5, 1e-8):
        run = diagram.simulate(20.0, solver=solver, rtol=rtol, atol=rtol / 100, progress=False)
        found = np.array([e.t for e in run.events])
        assert len(found) == len(crossings)
        errors.append(np.max(np.abs(found - crossings)))
    assert errors[0] < 3e-2
    assert errors[1] < 1e-4
    assert errors[1] < errors[0] / 10


@pytest.mark.drawn(1)
@pytest.mark.parametrize(("solver", "order"), [("rk4", 4), ("heun", 2), ("euler", 1)])
def test_each_fixed_step_finds_crossings_with_its_order(solver, order, crossings):
    diagram = Diagram("swing", Swing(name="swing", level=0.3))
    errors, n = [], (100, 200, 400) if order == 4 else (800, 1600, 3200)
    for steps in n:
        run = diagram.simulate(5.0, step=5.0 / steps, solver=solver, progress=False)
        errors.append(max(abs(e.t - c) for e, c in zip(run.events, crossings, strict=False)))
    assert -np.polyfit(np.log(n), np.log(errors), 1)[0] == pytest.approx(order, abs=0.4)


def test_where_the_solution_is_exact_the_instant_is_to_rounding():
    run = Diagram("d", Crossings(name="c")(Clock() - 0.7123456789)).simulate(1.0, step=0.5, progress=False)
    assert run["c.last"][-1] == pytest.approx(0.7123456789, abs=2e-16)


def test_the_indicator_has_changed_its_domain_at_the_instant_that_is_found():
    """A jump sees values on the far side: what it compares agrees with the event."""

    class Seen(Block):
        u = Input()
        right = State(discrete=True, output=True)
        cross = Event("rising")

        def indicators(self, t, x, u):
            return u.u

        def jump(self, t, x, u, fired):
            return x.right + np.where(u.u > 0.0, 1.0, -100.0)

    run = Diagram("d", Seen(name="s")(Sine(frequency=3.3, phase=-0.4))).simulate(10.0, step=0.1, progress=False)
    assert run["s.right"][-1] == len(run.events) == 33


@pytest.mark.parametrize(("direction", "count"), [("rising", 5), ("falling", 5), ("both", 10)])
def test_the_direction_counts(direction, count):
    run = Diagram("d", Crossings(name="c", direction=direction)(Sine(frequency=1.0, phase=-0.3))).simulate(
        5.0, step=0.05, progress=False
    )
    start, apart = {"rising": (0, 1), "falling": (0.5, 1), "both": (0, 0.5)}[direction]
    assert [e.t for e in run.events] == pytest.approx([0.3 / (2 * np.pi) + start + apart * k for k in range(count)])


def test_two_crossings_within_two_ticks_are_both_seen():
    """The indicator is above zero for a hundredth of a step that the solver could take."""
    bump = PiecewiseLinear(times=(0.0, 0.4, 0.41, 0.42, 1.0), values=(-1.0, -1.0, 1.0, -1.0, -1.0))
    run = Diagram("d", Crossings(name="c")(bump)).simulate(1.0, step=1.0, progress=False)
    assert [e.t for e in run.events] == pytest.approx([0.405, 0.415], abs=1e-14)


def test_a_step_of_a_source_across_zero_fires_at_its_instant():
    run = Diagram(
        "d", Crossings(name="c")(Step(times=(0.25, 0.5, 0.625), values=(1.0, -1.0, 2.0), initial_value=-1.0))
    ).simulate(1.0, step=0.25, progress=False)
    assert [e.t for e in run.events] == [0.25, 0.5, 0.625]
    assert run["c.count"].tolist() == [0, 1, 2, 3, 3]


def test_a_held_signal_that_crosses_at_a_tick_fires_at_that_tick():
    @subsystem(sample_time=0.1)
    def box(t):
        return Gain(gain=1.0, name="g")(t) - 0.45

    run = Diagram("d", Crossings(name="c")(box(Clock()))).simulate(1.0, progress=False)
    assert [e.t for e in run.events] == [0.5]


def test_an_indicator_that_starts_at_zero_fires_only_when_it_comes_back():
    run = Diagram("d", Crossings(name="c", direction="falling")(Sine(frequency=1.0))).simulate(
        1.2, step=0.1, progress=False
    )
    assert [e.t for e in run.events] == pytest.approx([0.5], abs=1e-15)


def test_a_hysteresis_moves_both_thresholds_apart():
    run = Diagram("d", Crossings(name="c", hysteresis=0.5)(Sine(frequency=1.0, phase=0.1))).simulate(
        1.0, step=0.01, progress=False
    )
    phase = 0.1 / (2 * np.pi)
    # at the start it is above zero; it falls below −1/2, then rises above 1/2 beyond the end
    assert [e.t for e in run.events] == pytest.approx([7 / 12 - phase], abs=1e-14)


def test_simultaneous_events_of_unrelated_blocks_are_one_instant():
    a, b = Crossings(name="a"), Crossings(name="b")
    u = Sine(frequency=1.0, phase=-1.0)
    run = Diagram("d", a(u), b(Gain(gain=3.0)(u))).simulate(1.0, step=0.1, progress=False)
    assert [e.block for e in run.events] == ["a", "b", "a", "b"]
    assert run.events[0].t == pytest.approx(run.events[1].t, abs=1e-15)


def test_an_event_at_a_tick_fires_once():
    """The bounce is at a tick; the tick and the solver both look there."""
    T = np.sqrt(2 / 9.81)
    run = Diagram("d", Ball(name="b", restitution=1.0), Falls(name="f")).simulate(1.0, step=0.125, **TIGHT)
    assert [e.t for e in run.events] == pytest.approx([T], abs=1e-12)
    for step in (0.25, 0.5, 1.0):
        count = Crossings(name="c")(Clock() - 0.5)
        assert len(Diagram("d", count).simulate(1.0, step=step, progress=False).events) == 1


def test_a_thermostat_switches_where_its_exponentials_say():
    lag, relay = Lag(name="lag", k=0.5), Relay(name="relay", on_point=1.0, off_point=0.6)
    heat = Gain(gain=-1.0, name="g")(relay(lag.y)) + 1.0
    run = Diagram("thermostat", lag(heat.named("heat"))).simulate(20.0, step=0.1, **TIGHT)
    t, y, u, times = 0.0, 0.0, 1.0, []
    while True:
        target = 1.0 if u else 0.6
        t, y, u = t - 2 * np.log((target - 2 * u) / (y - 2 * u)), target, 1.0 - u
        if t > 20:
            break
        times.append(t)
    assert [e.t for e in run.events] == pytest.approx(times, abs=1e-10)


# --- runs that can't go on ----------------------------------------------------------------------------------------------


class Sliding(Block):
    """ẋ = −sign: whatever side it is on, it comes back at once."""

    hysteresis: float = parameter(default=0.0)
    y = State(start=0.3, output=True)
    side = State(start=1.0, discrete=True, output=True)

    @property
    def events(self):
        return {"switch": Event("both", hysteresis=self.hysteresis, name="switch")}

    def derivative(self, t, x, u):
        return -x.side

    def indicators(self, t, x, u):
        return x.y

    def jump(self, t, x, u, fired):
        return x.y, np.where(x.y > 0.0, 1.0, -1.0)


def test_chattering_ends_in_an_error_that_names_the_event_and_keeps_the_run():
    with pytest.raises(
        SimulationError, match=r"slide, t = 0\.3.* s: the event 'switch' chatters.*hysteresis"
    ) as caught:
        Diagram("d", Sliding(name="slide")).simulate(1.0, step=0.01, progress=False)
    assert caught.value.block == "slide"
    assert caught.value.run.t[-1] == pytest.approx(0.3, abs=1e-6)


def test_a_hysteresis_resolves_chattering():
    delta = 1e-3
    run = Diagram("d", Sliding(name="slide", hysteresis=delta)).simulate(1.0, step=0.01, progress=False)
    assert np.max(np.abs(run["slide.y"][run.t > 0.31])) <= delta * (1 + 1e-9)
    first = 0.3 + delta
    expected = first + 2 * delta * np.arange(int((1.0 - first) / (2 * delta)) + 1)
    assert [e.t for e in run.events] == pytest.approx(expected.tolist(), abs=1e-9)


def test_zeno_behaviour_ends_in_an_error_that_names_the_event_the_ratio_and_the_limit():
    fall = np.sqrt(2 / 9.81)
    end = fall + 2 * 0.8 * fall / (1 - 0.8)
    with pytest.raises(SimulationError, match=r"'impact' shows Zeno behaviour.*shrink by 0\.8 each time") as caught:
        Diagram("d", Ball(name="ball")).simulate(10.0, **TIGHT)
    error = caught.value
    assert error.block == "ball"
    limit = float(re.search(r"infinitely often before t = (\S+) s", str(error))[1])
    assert limit == pytest.approx(end, abs=6e-9)  # as it is printed
    assert error.t == pytest.approx(end, abs=1e-5)
    assert len(error.run.events) > 60


@pytest.mark.slow
def test_a_ball_that_loses_no_energy_is_not_taken_for_zeno():
    run = Diagram("d", Ball(name="ball", restitution=1.0)).simulate(200.0, rtol=1e-9, atol=1e-12, progress=False)
    half = np.sqrt(2 / 9.81)
    assert [e.t for e in run.events] == pytest.approx([half * (2 * k + 1) for k in range(len(run.events))], rel=1e-6)
    assert len(run.events) == int((200.0 / half + 1) / 2)


@pytest.mark.slow
def test_a_decay_that_crosses_ever_faster_but_not_for_ever_is_not_taken_for_zeno():
    """A chirp: the intervals shrink, but their ratio tends to one."""
    chirp = Chirp(start_frequency=1.0, end_frequency=200.0, duration=2.0, phase=0.3)
    run = Diagram("d", Crossings(name="c")(chirp)).simulate(2.0, step=1e-3, progress=False)
    turns = 201 * 2 / 2 + 0.3 / (2 * np.pi)
    assert len(run.events) == int(2 * turns)


def test_events_that_fire_each_other_at_one_instant_end_in_an_error_that_names_them():
    class Follows(Block):
        """Takes u, or its opposite, whenever that changes."""

        inverted: bool = parameter(default=False, structural=True)
        u = Input()
        y = State(discrete=True, output=True)
        change = Event("both")

        def indicators(self, t, x, u):
            return u.u - 0.5

        def jump(self, t, x, u, fired):
            return np.where(u.u > 0.5, 0.0, 1.0) if self.inverted else np.where(u.u > 0.5, 1.0, 0.0)

    first, second = Follows(name="first", inverted=True), Follows(name="second")
    kick = Step(times=(0.5, 0.6), values=(1.0, 0.0))  # when it is over, an odd ring of inverters is left alone
    ring = first(second.y + kick), second(first.y)
    told = r"(first|second), t = 0\.6 s: events fire each other without end at one instant: after 100 rounds \1\.change"
    with pytest.raises(SimulationError, match=told) as caught:
        Diagram("d", *ring).simulate(1.0, step=0.1, progress=False)
    assert caught.value.run.t[-1] == 0.5


def test_an_error_at_an_event_has_its_time():
    class Breaks(Block):
        y = State(output=True, start=1.0)
        cross = Event("falling")

        def derivative(self, t, x, u):
            return -1.0 + 0.0 * x.y

        def indicators(self, t, x, u):
            return x.y - 0.25

        def jump(self, t, x, u, fired):
            return np.sqrt(x.y - 1.0)

    with pytest.raises(SimulationError, match=r"breaks.*t = 0\.75 s") as caught:
        Diagram("d", Integrator(name="after")(Breaks(name="breaks")), Constant(value=1.0)).simulate(
            1.0, step=0.1, progress=False
        )
    assert caught.value.run.t[-1] < 0.75


def test_an_event_far_from_the_start_is_found_as_exactly():
    take = Takes(name="take")(Clock(), Compare(">", name="c")(Clock(), 1e5 + 0.125))
    run = Diagram("d", take).simulate(1e5 + 1.0, step=1e5 + 1.0, progress=False)
    assert run.events[-1].t == pytest.approx(1e5 + 0.125, abs=3e-11)


@pytest.mark.slow
def test_many_events_at_one_instant_are_no_chattering():
    crossings = [Crossings(name=f"c{i}")(Clock() - 0.5) for i in range(600)]
    run = Diagram("d", *crossings).simulate(1.0, step=0.5, progress=False)
    assert len(run.events) == 600


def test_an_indicator_that_is_not_finite_ends_the_run_and_fires_nothing():
    class Rooted(Block):
        u = Input()
        count = State(discrete=True, output=True)
        cross = Event("both")

        def indicators(self, t, x, u):
            return np.sqrt(u.u) + 1.0

        def jump(self, t, x, u, fired):
            return x.count + 1.0

    told = r"rooted, t = 0\.\d+ s: its indicator 'cross' is not a finite number"
    with pytest.raises(NonFiniteError, match=told) as caught:
        Diagram("d", Rooted(name="rooted")(0.55 - Clock())).simulate(1.0, step=0.1, progress=False)
    assert caught.value.run.events == ()
    assert 0.5 <= caught.value.t <= 0.65
    root = Function(np.sqrt, name="root")
    with pytest.raises(NonFiniteError, match=r"root\.y, t = 0\.\d+ s: found \[nan\].*first block"):
        Diagram("d", Crossings(name="c")(root(0.55 - Clock()))).simulate(1.0, step=0.1, progress=False)


def test_a_jump_is_told_which_of_its_events_fired():
    class Two(Block):
        u = Input()
        code = State(discrete=True, output=True)
        one = Event("rising")
        two = Event("rising")

        def indicators(self, t, x, u):
            return u.u - 0.25, u.u - 0.5

        def jump(self, t, x, u, fired):
            return 10.0 * x.code + fired.one + 2.0 * fired.two

    u = Step(times=(0.1, 0.3, 0.5, 0.7), values=(0.3, 0.6, 0.0, 1.0))
    run = Diagram("d", Two(name="two")(u)).simulate(1.0, step=0.5, progress=False)
    assert run["two.code"][-1] == 123.0  # the first, the second, both
    assert [e.event for e in run.events] == ["one", "two", "one", "two"]


def test_events_of_unrelated_blocks_that_follow_closely_have_their_own_instants():
    run = Diagram("d", Crossings(name="late")(Clock() - 0.502), Crossings(name="early")(Clock() - 0.501)).simulate(
        1.0, step=1.0, progress=False
    )
    assert [e.block for e in run.events] == ["early", "late"]
    assert [e.t for e in run.events] == pytest.approx([0.501, 0.502], abs=1e-15)
    assert (run["early.last"][-1], run["late.last"][-1]) == pytest.approx((0.501, 0.502), abs=1e-15)
