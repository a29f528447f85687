"""Blocks that switch, in whole diagrams: closed forms in continuous time, tick by tick in sampled frames."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from loopwright.blocks import (
    And,
    Backlash,
    Block,
    Compare,
    Constant,
    Counter,
    GuardError,
    HandProfile,
    Input,
    Latch,
    Not,
    Output,
    Quantizer,
    RateLimiter,
    Relay,
    Requirement,
    Sine,
    SpringDamper,
    State,
    StateMachine,
    StopCondition,
    Switch,
    Wall,
    parameter,
)
from loopwright.diagrams import Diagram, subsystem

TIGHT = {"solver": "DOP853", "rtol": 1e-12, "atol": 1e-13, "progress": False}


class Lag(Block):
    """T ẏ = u − y."""

    time_constant: float = parameter(default=1.0)
    start: float = parameter(default=0.0)
    u = Input()
    y = State(start="start", output=True)

    def derivative(self, t, x, u):
        return (u.u - x.y) / self.time_constant


class Area(Block):
    """∫ u dt."""

    u = Input()
    y = State(output=True)

    def derivative(self, t, x, u):
        return u.u


class Mass(Block):
    """A mass on a line."""

    mass: float = parameter(default=1.0)
    speed: float = parameter(default=0.0)
    force = Input(unit="N")
    position = State(unit="m", output=True)
    velocity = State(unit="m/s", start="speed", output=True)

    def derivative(self, t, x, u):
        return x.velocity, u.force / self.mass


class Wave(Block):
    """sin t and its rate."""

    y = Output()
    rate = Output()

    def output(self, t, x, u):
        return np.sin(t), np.cos(t)


def times(run, event):
    return [o.t for o in run.events if o.event == event]


# --- continuous time ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_thermostat_switches_when_its_closed_form_does():
    heater = Relay(on_point=-19.0, off_point=-21.0, on_value=30.0, off_value=10.0, initially_on=True, name="heater")
    room = Lag(time_constant=10.0, start=20.0, name="room")
    run = Diagram("house", room(heater(-1.0 * room.y))).simulate(40.0, **TIGHT)
    now, y, wanted, aim = 0.0, 20.0, [], 30.0
    while now < 40.0:
        border = 21.0 if aim == 30.0 else 19.0
        now += 10.0 * np.log((aim - y) / (aim - border))
        y, aim = border, 40.0 - aim
        wanted.append(now)
    assert sorted([*times(run, "rise"), *times(run, "fall")]) == pytest.approx(wanted[:-1], abs=1e-9)
    assert run["room.y"].max() < 21.0 + 1e-9


@pytest.mark.slow
def test_the_area_under_a_quantized_sine_is_that_of_its_steps():
    q, end = 0.25, 2.0
    area = Area()
    run = Diagram("d", area(Quantizer(quantum=q)(Wave().y))).simulate(end, **TIGHT)
    middles = np.arcsin(q * (np.arange(4) + 0.5))
    steps = sum(q * (min(end, np.pi - t) - t) for t in middles)
    assert run["area.y"][-1] == pytest.approx(steps, abs=1e-11)


@pytest.mark.slow
def test_play_in_a_diagram_carries_what_follows():
    wave, area = Wave(), Area()
    run = Diagram("d", area(Backlash(width=0.6, with_rate=True)(wave.y, wave.rate))).simulate(3.0, **TIGHT)

    def play(t):
        u = np.sin(t)
        return 0.0 if t < np.arcsin(0.3) else u - 0.3 if t < np.pi / 2 else 0.7 if u > 0.4 else u + 0.3

    assert run["backlash.y"] == pytest.approx([play(t) for t in run.t], abs=1e-10)
    up, back = np.arcsin(0.3), np.pi - np.arcsin(0.4)
    whole = np.cos(up) - 0.3 * (np.pi / 2 - up) + 0.7 * (back - np.pi / 2)
    whole += np.cos(back) - np.cos(3.0) + 0.3 * (3.0 - back)
    assert run["area.y"][-1] == pytest.approx(whole, abs=1e-10)


def test_logic_that_changes_together_makes_no_glitch():
    # a and not a is never true, not even within the instant at which a changes
    high = Compare(">", name="high")(Wave().y, 0.5)
    never = And()(high, Not()(high))
    run = Diagram(
        "d", Counter(name="glitches")(never), Counter(name="rises")(high), Latch(name="ever")(never)
    ).simulate(10.0, **TIGHT)
    assert run["rises.y"][-1] == 2.0
    assert not run["glitches.y"].any()
    assert not run["ever.y"].any()


@pytest.mark.slow
def test_a_switch_changes_where_its_condition_does():
    wave, area = Wave(), Area()
    run = Diagram("d", area(Switch()(Compare("<")(wave.y, 0.5), wave.y, 2.0))).simulate(3.0, **TIGHT)
    a, b = np.pi / 6, 5 * np.pi / 6
    assert run["area.y"][-1] == pytest.approx(1 - np.cos(a) + 2 * (b - a) + np.cos(b) - np.cos(3.0), abs=1e-11)


def test_a_run_of_approach_contact_and_retract_in_continuous_time():
    # pushed by 1 N out of rest; from 1 m on it is held for 0.4 s by the machine, then pulled back
    machine = StateMachine(
        modes=("approach", "contact", "retract"),
        transitions={("approach", "contact"): "touch", ("contact", "retract"): "done"},
        name="machine",
    )
    body = Mass(name="body")
    modes = machine(
        touch=Compare(">", name="near")(body.position, 1.0), done=Compare(">", name="late")(machine.time_in_mode, 0.4)
    )
    force = machine.approach * 1.0 + machine.retract * -2.0
    over = Compare("<", name="back")(body.velocity, -1.0)
    run = Diagram("d", body(force), modes, StopCondition(name="stop")(over)).simulate(9.0, **TIGHT)
    touch = np.sqrt(2.0)
    assert times(run, "approach_to_contact") == pytest.approx([touch], abs=1e-11)
    assert times(run, "contact_to_retract") == pytest.approx([touch + 0.4], abs=1e-11)
    end = touch + 0.4 + (touch + 1.0) / 2.0
    assert run.t[-1] == pytest.approx(end, abs=1e-10)
    assert run["body.velocity"][-1] == pytest.approx(-1.0, abs=1e-10)
    assert run["machine.mode"][-1] == 2.0


@pytest.mark.slow
def test_a_body_comes_off_a_damped_wall_as_scipy_says():
    k, d = 400.0, 6.0
    body, wall = Mass(speed=1.0, name="body"), Wall(stiffness=k, damping=d, point=0.5, normal=-1.0, name="wall")
    run = Diagram("d", body(wall(body.position, body.velocity).force)).simulate(1.5, **TIGHT)

    def lost(t, y):
        return k * y[0] + d * y[1]

    lost.terminal, lost.direction = True, -1.0
    made = solve_ivp(
        lambda t, y: [y[1], -k * y[0] - d * y[1]],
        (0.0, 1.0),
        [0.0, 1.0],
        events=lost,
        rtol=1e-13,
        atol=1e-14,
        method="DOP853",
    )
    out, (depth, speed) = 0.5 + made.t[-1], made.y[:, -1]
    assert run["body.velocity"][-1] == pytest.approx(speed, abs=1e-9)
    assert run["body.position"][-1] == pytest.approx(0.5 + depth + speed * (1.5 - out), abs=1e-9)
    assert run["wall.force"].max() <= 0.0


def test_a_hand_through_a_spring_holds_a_body_still():
    hand = HandProfile(start_time=0.5, hold_time=40.0, peak_force=12.0)
    body = Mass(name="body")
    held = SpringDamper(stiffness=100.0, damping=20.0)(body.position, body.velocity)
    run = Diagram("d", body(hand.force + held)).simulate(6.0, progress=False)
    assert run["body.position"][-1] == pytest.approx(0.12, abs=1e-6)


def test_a_rate_limiter_in_continuous_time_lags_by_its_time_constant():
    limiter = RateLimiter(rising=2.0, time_constant=0.05, initial_value=0.0)
    run = Diagram("d", limiter(Constant(value=1.0))).simulate(1.0, **TIGHT)
    want = [2.0 * t if t < 0.45 else 1.0 - 0.1 * np.exp(-(t - 0.45) / 0.05) for t in run.t]
    assert run["rate_limiter.y"] == pytest.approx(want, abs=1e-9)


# --- requirements -------------------------------------------------------------------------------------------------------


def test_a_requirement_stops_the_run_where_it_breaks_and_keeps_what_was_recorded():
    room = Lag(time_constant=10.0, name="room")
    cool = Requirement("the room stays below 5.5 degC", upper=5.5, name="cool")
    with pytest.raises(
        GuardError, match=r"^cool, t = 7\.9850769\d* s: the requirement 'the room stays below 5\.5 degC' is"
    ) as error:
        Diagram("d", room(10.0), cool(room.y)).simulate(40.0, **TIGHT)
    assert error.value.t == pytest.approx(-10.0 * np.log(0.45), abs=1e-9)
    assert error.value.run["room.y"].max() <= 5.5 + 1e-9
    assert error.value.run.t[-1] > 7.9


@pytest.mark.slow
def test_a_recorded_violation_lets_the_run_go_on():
    room = Lag(time_constant=10.0, name="room")
    cool = Requirement("cool", upper=5.5, on_violation="record", name="cool")
    run = Diagram("d", room(10.0), cool(room.y)).simulate(40.0, **TIGHT)
    assert run.t[-1] == 40.0
    assert run["cool.violated_at"][-1] == pytest.approx(-10.0 * np.log(0.45), abs=1e-9)
    assert run["cool.violated"][0] == 0.0


# --- sampled frames -----------------------------------------------------------------------------------------------------


def test_a_sampled_machine_acts_at_its_ticks_and_stops_the_run():
    @subsystem(sample_time=0.1)
    def box(u):
        machine = StateMachine(
            modes=("approach", "contact", "retract"),
            transitions={("approach", "contact"): "touch", ("contact", "retract"): "done"},
            name="machine",
        )
        machine(touch=Compare(">", name="near")(u, 0.5), done=Compare(">", name="late")(machine.time_in_mode, 0.35))
        StopCondition(name="stop")(machine.retract)
        return machine.mode.named("mode")

    run = Diagram("d", box(Sine(frequency=0.1))).simulate(5.0, progress=False)
    # sin(2π 0.1 t) > 0.5 first at the tick 0.9 s; 4 ticks in contact are more than 0.35 s
    assert run["mode"].tolist() == [0.0] * 10 + [1.0] * 5 + [2.0]
    assert run.t[-1] == 1.5


def test_a_requirement_breaks_at_a_tick():
    @subsystem(sample_time=0.1)
    def box(u):
        return Requirement("u stays below 0.5", upper=0.5, name="low")(u).violated

    with pytest.raises(
        GuardError, match=r"^box\.low, t = 0\.9 s: the requirement 'u stays below 0\.5' is violated"
    ) as error:
        Diagram("d", box(Sine(frequency=0.1))).simulate(5.0, progress=False)
    assert error.value.run.t[-1] == pytest.approx(0.8)
