"""Contact that is reached, or started at, is contact: an indicator at zero fires by the direction in which it leaves."""

import numpy as np
import pytest

from loopwright.blocks import Block, Clock, Event, Gain, Input, SimulationError, Sine, State, parameter
from loopwright.diagrams import Diagram
from loopwright.fmus import bouncing_ball
from support.hybrid_blocks import Crossings

G = 9.81
METHODS = ["auto", "RK45", "DOP853", "Radau", "BDF", "LSODA", "CVODE_BDF", "CVODE_Adams", "rk4"]


class Drop(Block):
    """A mass over a floor: its jump takes it to the floor, or leaves it where it is found."""

    floor: float = parameter(default=0.0)
    restitution: float = parameter(default=0.0)
    to_floor: bool = parameter(default=True, structural=True)
    start_height: float = parameter(default=1.0)
    start_speed: float = parameter(default=0.0)
    lift: float = parameter(default=0.0)
    h = State(start="start_height", output=True)
    v = State(start="start_speed", output=True)
    impact = Event("falling")

    def derivative(self, t, x, u):
        return x.v, self.lift - G + 0.0 * t

    def indicators(self, t, x, u):
        return x.h - self.floor

    def jump(self, t, x, u, fired):
        return (self.floor + 0.0 * x.h if self.to_floor else x.h), -self.restitution * x.v


@pytest.mark.parametrize("solver", METHODS)
@pytest.mark.parametrize("to_floor", [True, False])
@pytest.mark.parametrize("floor", [0.0, 0.1, 1000.0])
@pytest.mark.drawn(4)
def test_an_inelastic_impact_rests_in_contact_and_says_so(solver, to_floor, floor):
    block = Drop(name="mass", floor=floor, to_floor=to_floor, start_height=floor + 1.0)
    with pytest.raises(SimulationError, match=r"mass, t = 0\.45.*'impact' rests in contact.*state of rest") as caught:
        Diagram("d", block).simulate(1.0, step=0.01, rtol=1e-8, atol=1e-8, solver=solver, progress=False)
    error = caught.value
    assert error.block == "mass"
    assert error.t == pytest.approx(np.sqrt(2 / G), abs=1e-4)
    assert error.run["mass.h"].min() >= floor
    assert {e.event for e in error.run.events} == {"impact"}


@pytest.mark.parametrize("to_floor", [True, False])
@pytest.mark.parametrize(("speed", "solver"), [(-2.0, "auto"), (-2.0, "LSODA"), (-1e-3, "RK45"), (-2.0, "rk4")])
@pytest.mark.drawn(4)
def test_a_start_in_contact_that_moves_into_it_is_an_impact(speed, solver, to_floor):
    block = Drop(name="mass", restitution=0.5, start_height=0.0, start_speed=speed, to_floor=to_floor)
    end = round(0.6 * abs(speed) / G, 6)  # the first flight takes |v|/g
    run = Diagram("d", block).simulate(end, solver=solver, step=end / 2, progress=False)
    assert [e.t for e in run.events] == pytest.approx([0.0], abs=1e-9)
    assert run["mass.h"][-1] == pytest.approx(0.5 * abs(speed) * end - G / 2 * end**2, abs=1e-4 * abs(speed))


def test_a_start_in_contact_bounces_as_its_closed_form():
    v, e = 2.0, 0.5
    block = Drop(name="mass", restitution=e, start_height=0.0, start_speed=-v)
    run = Diagram("d", block).simulate(0.37, step=0.001, rtol=1e-10, atol=1e-12, progress=False)
    flights = 2 * e * v / G * np.cumsum([0.0, 1.0, e, e**2, e**3])
    expected = flights[flights < 0.37]
    assert [event.t for event in run.events] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("speed", [0.0, -0.5])
def test_a_start_on_the_floor_without_a_way_out_is_a_rest(speed):
    with pytest.raises(SimulationError, match="'impact' rests in contact") as caught:
        Diagram("d", Drop(name="mass", start_height=0.0, start_speed=speed)).simulate(1.0, step=0.01, progress=False)
    assert caught.value.t == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("compiled", ["auto", True])
@pytest.mark.parametrize("solver", ["auto", "RK45", "Radau", "LSODA", "CVODE_Adams", "rk4"])
@pytest.mark.parametrize(
    ("restitution", "height", "floor"),
    [(0.8, 0.0, 0.0), (0.8, 0.0, 1000.0), (0.99, 0.0, 0.0), (0.5, 1e-12, 0.0), (0.8, 1e-9, 0.1), (0.8, 1e-6, 0.0)],
)
@pytest.mark.drawn(3)
def test_a_ball_whose_flights_shrink_to_nothing_ends_in_an_error_soon_after(
    restitution, height, floor, solver, compiled
):
    """The last flight is over after (1 + e)/(1 − e) times the fall: then it would rest, whether it has fallen or not."""
    ball = Drop(name="mass", restitution=restitution, floor=floor, start_height=floor + height)
    tick = 0.01
    with pytest.raises(
        SimulationError, match=r"'impact' (rests in contact|shows Zeno behaviour).*state of rest"
    ) as caught:
        Diagram("d", ball).simulate(1.0, step=tick, solver=solver, compile=compiled, progress=False)
    end = np.sqrt(2 * height / G) * (1 + restitution) / (1 - restitution)
    assert caught.value.t <= end + 0.1 * tick
    assert len(caught.value.run.events) < 3000
    assert caught.value.run["mass.h"].min() >= floor - 1e-9


def test_a_ball_that_loses_nothing_bounces_however_low_it_is():
    """From 1e-11 m: 350 impacts, in ten ticks."""
    height = 1e-11
    ball = Drop(name="mass", restitution=1.0, start_height=height, to_floor=False)
    run = Diagram("d", ball).simulate(1e-3, step=1e-4, rtol=1e-10, atol=1e-22, progress=False)
    half = np.sqrt(2 * height / G)
    assert len(run.events) == int((1e-3 / half + 1) / 2)
    assert run.events[20].t == pytest.approx(41 * half, rel=1e-6)


def test_a_start_in_contact_that_leaves_it_is_no_impact():
    block = Drop(name="mass", restitution=0.5, start_height=0.0, start_speed=1.0)
    run = Diagram("d", block).simulate(0.3, step=0.01, rtol=1e-10, atol=1e-12, progress=False)
    assert [event.t for event in run.events] == pytest.approx([2.0 / G], abs=1e-9)
    lifted = Diagram("d", Drop(name="mass", start_height=0.0, lift=2 * G)).simulate(1.0, step=0.01, progress=False)
    assert lifted.events == ()
    assert lifted["mass.h"][-1] == pytest.approx(G / 2, rel=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("direction", ["rising", "falling", "both"])
def test_an_indicator_at_zero_at_the_start_fires_by_the_direction_in_which_it_leaves(direction, sign):
    """sin ωt rises at the start, −sin ωt falls: the two directions mirror each other."""
    crossings = Crossings(name="c", direction=direction)(Gain(gain=sign, name="g")(Sine(frequency=1.0)))
    run = Diagram("d", crossings).simulate(1.2, step=0.1, progress=False)
    up = "rising" if sign > 0 else "falling"
    expected = {up: [0.0, 1.0], "both": [0.0, 0.5, 1.0]}.get(direction, [0.5])
    assert [e.t for e in run.events] == pytest.approx(expected, abs=1e-13)


def test_an_indicator_that_comes_to_zero_by_itself_fires_once():
    """It stops at zero for a while, then goes on: it has fallen already."""

    class Stops(Block):
        z = State(start=0.5, output=True)
        count = State(discrete=True, output=True)
        fall = Event("falling")

        def derivative(self, t, x, u):
            return np.where(t < 0.5, -1.0, np.where(t < 0.75, 0.0, -1.0))

        def indicators(self, t, x, u):
            return x.z

        def jump(self, t, x, u, fired):
            return 0.0 * x.z, x.count + 1.0

    run = Diagram("d", Stops(name="s")).simulate(1.0, step=0.25, solver="rk4", progress=False)
    assert run["s.count"][-1] == 1.0


class Puck(Block):
    """A mass that stays on the floor after an impact, until the force on it exceeds its weight."""

    force = Input()
    h = State(start=0.2, output=True)
    v = State(output=True)
    contact = State(discrete=True, output=True)
    impact = Event("falling")
    lift = Event("rising")

    def derivative(self, t, x, u):
        return x.v, np.where(x.contact > 0.5, 0.0, u.force - G)

    def indicators(self, t, x, u):
        return x.h, np.where(x.contact > 0.5, u.force - G, -1.0)

    def jump(self, t, x, u, fired):
        hit = fired.impact > 0.5
        return np.where(hit, 0.0, x.h), np.where(hit, 0.0, x.v), np.where(hit, 1.0, 0.0)


class Swing(Block):
    """φ̈ = −φ from φ = 0; at each fall through 0 a clock is set back, and the damping may change with a mode."""

    switches: bool = parameter(default=False, structural=True)
    phi = State(output=True)
    rate = State(start=1.0, output=True)
    clock = State(output=True)
    mode = State(discrete=True)
    fall = Event("falling")

    def derivative(self, t, x, u):
        return x.rate, -x.phi - 0.1 * x.mode * x.rate, 1.0 + 0.0 * t

    def indicators(self, t, x, u):
        return x.phi

    def jump(self, t, x, u, fired):
        return x.phi, x.rate, 0.0 * x.clock, (1.0 - x.mode) if self.switches else x.mode


@pytest.mark.drawn(1)
@pytest.mark.parametrize("switches", [False, True])
@pytest.mark.parametrize("solver", ["auto", "BDF", "rk4"])
def test_a_jump_that_leaves_the_motion_of_its_indicator_alone_is_no_impact(solver, switches):
    run = Diagram("d", Swing(name="s", switches=switches)).simulate(
        13.0, step=0.01, rtol=1e-9, atol=1e-11, solver=solver, progress=False
    )
    damped = np.pi / np.sqrt(1 - 0.05**2) if switches else np.pi
    assert [e.t for e in run.events] == pytest.approx([np.pi, np.pi + 2 * damped], abs=1e-6)
    assert run["s.clock"][-1] == pytest.approx(13.0 - np.pi - 2 * damped, abs=1e-6)


def test_a_mass_that_sticks_is_let_go_to_either_side():
    """A mode holds it at v = 0: leaving that is no impact, though the jump has set v to 0."""

    class Sticks(Block):
        force = Input()
        v = State(start=1.0, output=True)
        stuck = State(discrete=True)
        stop = Event("falling")
        slip = Event("rising")

        def derivative(self, t, x, u):
            return np.where(x.stuck > 0.5, 0.0, u.force)

        def indicators(self, t, x, u):
            return x.v, np.where(x.stuck > 0.5, np.abs(u.force) - 1.5, -1.0)

        def jump(self, t, x, u, fired):
            return np.where(fired.stop > 0.5, 0.0, x.v), np.where(fired.stop > 0.5, 1.0, 0.0)

    run = Diagram("d", Sticks(name="m")(Gain(gain=-1.0, name="g")(Clock()))).simulate(2.0, step=0.01, progress=False)
    assert [e.event for e in run.events] == ["stop", "slip"]
    assert [e.t for e in run.events] == pytest.approx([np.sqrt(2), 1.5], abs=1e-6)
    assert run["m.v"][-1] == pytest.approx(-(2.0**2 - 1.5**2) / 2, abs=1e-6)


@pytest.mark.drawn(1)
@pytest.mark.parametrize("solver", ["auto", "DOP853", "BDF", "rk4"])
def test_contact_that_is_held_is_left_when_a_force_lifts(solver):
    """The force is 12 t, from the weight at t₁ = g/12 on ḧ = 12 (t − t₁)."""
    puck = Puck(name="puck")(Gain(gain=12.0, name="k")(Clock()))
    run = Diagram("d", puck).simulate(2.0, step=0.001, rtol=1e-9, atol=1e-11, solver=solver, progress=False)
    first, lifted = G / 12, run["puck.h"][run.t > G / 12]
    assert [e.event for e in run.events] == ["impact", "lift"]
    assert run.events[1].t == pytest.approx(first, abs=1e-12)
    assert lifted == pytest.approx(2.0 * (run.t[run.t > first] - first) ** 3, abs=1e-7)
    rests = (run.t > run.events[0].t) & (run.t < first)
    assert np.all(run["puck.h"][rests] == 0.0)


def test_a_bouncing_ball_comes_to_rest_after_the_time_of_its_geometric_series():
    ball = bouncing_ball.BouncingBall(name="ball", gravity=G, restitution=0.5, resting_speed=0.05, start_height=1.0)
    run = Diagram("d", ball).simulate(3.0, step=0.01, rtol=1e-10, atol=1e-12, progress=False)
    fall, speed, at = np.sqrt(2 / G), np.sqrt(2 * G), [np.sqrt(2 / G)]
    while (speed := 0.5 * speed) >= 0.05:
        at.append(at[-1] + 2 * speed / G)
    assert [e.t for e in run.events] == pytest.approx(at, abs=1e-8)
    assert at[0] == fall
    assert np.all(run["ball.height"][run.t > at[-1]] == 0.0)


def test_an_impact_is_passed_on_along_a_row_of_masses_that_touch():
    """Newton's cradle: all is over at the start, and only the last one moves."""

    class Cradle(Block):
        x = State(start=(0.0,) * 4, output=True)
        v = State(start=(1.0, 0.0, 0.0, 0.0), output=True)
        first, second, third = Event("falling"), Event("falling"), Event("falling")

        def derivative(self, t, x, u):
            return x.v, 0.0 * x.v

        def indicators(self, t, x, u):
            return x.x[1] - x.x[0], x.x[2] - x.x[1], x.x[3] - x.x[2]

        def jump(self, t, x, u, fired):
            v = [x.v[i] for i in range(4)]
            for i, hit in enumerate(fired):
                a, b = v[i], v[i + 1]
                v[i], v[i + 1] = np.where(hit > 0.5, b, a), np.where(hit > 0.5, a, b)
            return x.x, np.stack(v)

    run = Diagram("d", Cradle(name="row")).simulate(1.0, step=0.1, progress=False)
    assert run["row.v"][-1] == pytest.approx([0.0, 0.0, 0.0, 1.0])
    assert run["row.x"][-1] == pytest.approx([0.0, 0.0, 0.0, 1.0], abs=1e-9)
    assert [e.event for e in run.events] == ["first", "second", "third"]
