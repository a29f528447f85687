"""Everyday systems with switching, friction, sampling and delays, each against an oracle of its own."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from loopwright.blocks import (
    Block,
    Compare,
    Constant,
    DiscreteIntegrator,
    Event,
    Function,
    Input,
    Integrator,
    LimitedIntegrator,
    PulseTrain,
    Quantizer,
    Relay,
    Sine,
    State,
    StateSpace,
    Switch,
    TransferFunction,
    TransportDelay,
    UnitDelay,
    parameter,
)
from loopwright.diagrams import Diagram, subsystem

TIGHT = {"rtol": 1e-10, "atol": 1e-12, "progress": False}


def exact_hold(A, B, h):
    """Return Φ and Γ of x(t + h) = Φ x + Γ u for x' = A x + B u, u held."""
    n, m = np.shape(B)
    whole = expm(h * np.block([[A, B], [np.zeros((m, n + m))]]))
    return whole[:n, :n], whole[:n, n:]


class Saw(Block):
    """A rising saw-tooth between 0 and 1."""

    period: float = parameter()
    level = State(output=True)
    fall = Event("rising")

    def derivative(self, t, x, u):
        return 1 / self.period + 0.0 * x.level

    def indicators(self, t, x, u):
        return x.level - 1.0

    def jump(self, t, x, u, fired):
        return 0.0 * x.level


# --- switching -------------------------------------------------------------------------------------------------------


def test_a_thermostat_switches_at_the_instants_of_the_closed_form():
    """τ T' = T_a − T + P h with a relay at 20 ± 1: the times between switchings are logarithms."""
    tau, ambient, power = 50.0, 5.0, 25.0
    relay = Relay(on_point=1.0, off_point=-1.0, initially_on=True, name="relay")
    room = Integrator(initial_value=ambient, name="room")
    rate = (ambient - room.y + power * relay(20.0 - room.y)) / tau
    run = Diagram("house", room(rate)).simulate(300.0, step=1.0, **TIGHT)
    times, temperature, target, on = [0.0], ambient, 21.0, True
    while times[-1] < 300.0:
        limit = ambient + power * on
        times.append(times[-1] + tau * math.log((temperature - limit) / (target - limit)))
        temperature, target, on = target, 40.0 - target, not on
    found = np.array([event.t for event in run.events])
    assert len(found) == len(times) - 2 > 12
    assert np.max(np.abs(found - times[1:-1])) < 1e-7


def test_a_pulse_width_modulator_makes_the_ripple_of_the_closed_form():
    """Saw-tooth and comparator drive RC; the valleys obey a recursion, and the peaks lie above them."""
    duty, period, rc = 0.3, 0.01, 0.02
    high = Compare("<", name="high")(Saw(period=period, name="saw").level, Constant(value=duty))
    low_pass = TransferFunction(numerator=[1.0], denominator=[rc, 1.0], name="rc")
    voltage = Switch(name="v")(condition=high, then=Constant(value=1.0), otherwise=Constant(value=0.0))
    run = Diagram("pwm", low_pass(voltage)).simulate(0.5, step=period / 10, **TIGHT)
    valleys = [0.0]
    for _ in range(50):
        peak = 1 + (valleys[-1] - 1) * math.exp(-duty * period / rc)
        valleys.append(peak * math.exp(-(1 - duty) * period / rc))
    assert np.max(np.abs(run["rc.y"][::10] - valleys)) < 1e-8
    assert run["rc.y"][493] == pytest.approx(peak, abs=1e-8)


def test_a_schmitt_trigger_oscillates_with_the_period_of_the_closed_form():
    """An RC between ±1/3 that is charged towards ±1: half a period is RC ln 2."""
    trigger = Relay(on_point=1 / 3, off_point=-1 / 3, on_value=-1.0, off_value=1.0, name="trigger")
    capacitor = Integrator(name="capacitor")
    diagram = Diagram("oscillator", capacitor(trigger(capacitor.y) - capacitor.y))
    times = np.array([event.t for event in diagram.simulate(20.0, step=0.1, **TIGHT).events])
    first = math.log(1.5)
    assert np.max(np.abs(times - first - math.log(2.0) * np.arange(len(times)))) < 1e-8
    assert len(times) == 1 + int((20.0 - first) / math.log(2.0))


def test_antilock_braking_switches_as_an_integration_of_its_pieces_does():
    """m v' = −F, J ω' = R F − T, T' = ±q by a relay on the slip."""
    m, inertia, radius, rate, start = 400.0, 1.0, 0.3, 8000.0, (25.0, 25.0 / 0.3)

    def force(v, omega):
        slip = (v - radius * omega) / v
        return m * 9.81 * 2 * 0.9 * 0.15 * slip / (0.15**2 + slip**2)

    class Wheel(Block):
        torque = Input()
        v = State(start=start[0], output=True)
        omega = State(start=start[1], output=True)

        def derivative(self, t, x, u):
            f = force(x.v, x.omega)
            return -f / m, (radius * f - u.torque) / inertia

    wheel, brake = Wheel(name="wheel"), LimitedIntegrator(lower=0.0, name="brake")
    relay = Relay(on_point=0.18, off_point=0.16, on_value=-rate, off_value=rate, name="valve")
    slip = Function(lambda v, omega: 1.0 - radius * omega / v, name="slip")(wheel.v, wheel.omega)
    run = Diagram("abs", wheel(brake(relay(slip)))).simulate(1.0, step=0.01, **TIGHT)

    def rates(t, y, pressing):
        f = force(y[0], y[1])
        return [-f / m, (radius * f - y[2]) / inertia, pressing]

    def reach(limit, direction):
        def event(t, y, pressing):
            return 1 - radius * y[1] / y[0] - limit

        event.terminal, event.direction = True, direction
        return event

    t, y, pressing, switched = 0.0, np.array([*start, 0.0]), rate, []
    while t < 1.0:
        event = reach(0.18, 1) if pressing > 0 else reach(0.16, -1)
        piece = solve_ivp(rates, (t, 1.0), y, "DOP853", rtol=1e-12, atol=1e-12, args=(pressing,), events=event)
        t, y = piece.t[-1], piece.y[:, -1]
        assert piece.y[2].min() >= 0.0  # the limit of the pressure is not met, here and in the diagram
        if piece.t_events[0].size:
            switched.append(t)
            pressing = -pressing
    found = np.array([event.t for event in run.events if event.block == "valve"])
    assert len(found) == len(switched) > 4
    assert np.max(np.abs(found - switched)) < 1e-6
    assert [run["wheel.v"][-1], run["wheel.omega"][-1]] == pytest.approx(y[:2], rel=1e-6)


def test_a_buck_converter_is_its_matrix_exponentials():
    """i' = (d E − v)/L, v' = (i − v/R)/C with a pulse train as d, in continuous conduction."""
    supply, inductance, capacity, load, period, duty = 24.0, 1e-3, 1e-4, 2.0, 1e-4, 0.5
    A = np.array([[0.0, -1 / inductance], [1 / capacity, -1 / (load * capacity)]])
    B = np.array([[supply / inductance], [0.0]])
    filter_ = StateSpace(A=A, B=B[:, 0], C=np.eye(2), D=np.zeros(2), name="filter")
    gate = PulseTrain(period=period, duty=duty, name="gate")
    run = Diagram("buck", filter_(gate())).simulate(0.01, step=period, **TIGHT)
    x, rows = np.zeros((2, 1)), [np.zeros(2)]
    (on, kick), (off, _) = exact_hold(A, B, duty * period), exact_hold(A, B, (1 - duty) * period)
    for _ in range(100):
        x = off @ (on @ x + kick)
        rows.append(x[:, 0])
    assert np.max(np.abs(run["filter.y"] - rows)) < 1e-7 * supply


# --- friction --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_block_on_a_belt_sticks_and_slips_with_the_period_of_the_closed_form():
    """A spring holds a block on a moving belt; static friction F_s, sliding friction F_k."""
    mass, spring, belt, static, sliding = 1.0, 100.0, 0.1, 8.0, 5.0

    class Slider(Block):
        """Two modes: it moves with the belt until the spring pulls F_s, then slides until it is as fast again."""

        x = State(output=True)
        v = State(start=belt, output=True)
        slides = State(discrete=True, output=True)
        breaks = Event("rising")
        sticks = Event("rising")

        def derivative(self, t, x, u):
            return x.v, x.slides * (sliding - spring * x.x) / mass

        def indicators(self, t, x, u):
            sticking = 1.0 - x.slides
            return sticking * (spring * x.x - static) - x.slides, x.slides * (x.v - belt) - 1e-3 * sticking

        def jump(self, t, x, u, fired):
            stops = fired.sticks > 0.5
            return x.x + 0.0, np.where(stops, belt + 0.0 * x.v, x.v), np.where(stops, 0.0, 1.0)

    run = Diagram("belt", Slider(name="s")).simulate(8.0, step=0.01, **TIGHT)
    omega = math.sqrt(spring / mass)
    a = (static - sliding) / spring  # where it breaks loose, from the sliding equilibrium
    slide = 2 * (math.pi - math.atan2(a * omega, belt)) / omega  # x' is the belt's speed again at −a
    stick = 2 * a / belt
    breaks = np.array([event.t for event in run.events if event.event == "breaks"])
    sticks = np.array([event.t for event in run.events if event.event == "sticks"])
    assert len(breaks) == 8
    assert np.max(np.abs(breaks - (static / spring / belt + (slide + stick) * np.arange(len(breaks))))) < 1e-6
    assert np.max(np.abs(sticks - breaks[: len(sticks)] - slide)) < 1e-6


# --- sampling --------------------------------------------------------------------------------------------------------


def test_a_delta_sigma_modulator_is_its_recursion():
    """s[k + 1] = s[k] + u[k] − y[k], y = ±1 by the sign of s."""

    @subsystem(sample_time=1e-3)
    def modulator(u):
        total = DiscreteIntegrator(gain=1e3, name="total")
        high = Compare(">=", name="high")(total.y, Constant(value=0.0))
        bit = Switch(name="bit")(condition=high, then=Constant(value=1.0), otherwise=Constant(value=-1.0))
        total(u - bit)
        return bit.named("bits")

    run = Diagram("adc", modulator(Sine(amplitude=0.7, frequency=2.0, name="u"))).simulate(1.0, progress=False)
    total, bits = 0.0, []
    for u in 0.7 * np.sin(2 * np.pi * 2.0 * run.t):
        bits.append(1.0 if total >= 0 else -1.0)
        total += u - bits[-1]
    assert np.array_equal(run["bits"], bits)
    assert abs(np.mean(run["bits"][:500])) < 2 / 500 + 1e-12  # the mean of a period of the sine, to two levels


def test_three_rates_around_a_motor_are_products_of_their_exact_transitions():
    """Position 10 ms around speed 2 ms around current 0.5 ms, each P or PI, around R, L, J: by hand, tick by tick."""
    R, L, k, J = 1.0, 1e-3, 0.05, 1e-4
    A = np.array([[-R / L, -k / L, 0.0], [k / J, 0.0, 0.0], [0.0, 1.0, 0.0]])
    B = np.array([1 / L, 0.0, 0.0])
    motor = StateSpace(A=A, B=B, C=np.eye(3), D=np.zeros(3), name="motor")

    @subsystem(sample_time=5e-4)
    def current_loop(target, current):
        error, total = target - current, DiscreteIntegrator(gain=200.0, name="total")
        return (2.0 * error + total(error)).named("voltage")

    @subsystem(sample_time=2e-3)
    def speed_loop(target, speed):
        return (0.2 * (target - speed)).named("current")

    @subsystem(sample_time=1e-2)
    def position_loop(target, angle):
        return (15.0 * (target - angle)).named("speed")

    speed = position_loop(Constant(value=1.0), motor.y[2])
    voltage = current_loop(speed_loop(speed, motor.y[1]), motor.y[0])
    run = Diagram("drive", motor(voltage)).simulate(0.5, **TIGHT)
    transition, kick = exact_hold(A, B[:, None], 5e-4)
    x, total, rows = np.zeros(3), 0.0, []
    for i in range(1001):
        rows.append(x)
        if i % 20 == 0:
            speed_target = 15.0 * (1.0 - x[2])
        if i % 4 == 0:
            current_target = 0.2 * (speed_target - x[1])
        error = current_target - x[0]
        u = 2.0 * error + total
        total += 200.0 * 5e-4 * error
        x = transition @ x + kick[:, 0] * u
    size = np.max(np.abs(rows), axis=0)
    assert size[2] > 0.9
    assert np.max(np.abs(run["motor.y"] - rows) / size) < 1e-8


def test_a_short_pulse_between_two_samples_is_what_the_exact_transition_makes_of_it():
    """A pulse of 0.3 ms in a period of 50 ms disturbs a sampled PI loop around a lag."""
    tau, T, width, period = 0.1, 0.01, 3e-4, 0.05

    @subsystem(sample_time=T)
    def controller(y):
        error, total = 1.0 - y, DiscreteIntegrator(gain=8.0, name="total")
        return (2.0 * error + total(error)).named("u")

    plant = Integrator(name="plant")
    pulse = PulseTrain(amplitude=50.0, period=period, duty=width / period, delay=0.003, name="pulse")
    run = Diagram("loop", plant((controller(plant.y) + pulse() - plant.y) / tau)).simulate(1.0, **TIGHT)
    y, total, rows = 0.0, 0.0, []
    for i in range(101):
        rows.append(y)
        u, decay = 2.0 * (1.0 - y) + total, math.exp(-T / tau)
        total += 8.0 * T * (1.0 - y)
        y = decay * y + (1 - decay) * u
        if i % 5 == 0:  # from 3 ms on, 6.7 ms before the next sample
            y += 50.0 * (math.exp(-(T - 0.003 - width) / tau) - math.exp(-(T - 0.003) / tau))
    assert np.max(np.abs(run["plant.y"] - rows)) < 1e-8


def test_an_encoder_with_a_differentiator_behind_it_is_its_recursion():
    """Position in steps of 1/100, differenced and filtered at 1 kHz: floor and a first-order recursion."""
    step, T, keep = 0.01, 1e-3, 0.9

    @subsystem(sample_time=T)
    def speed(position):
        counts = Quantizer(quantum=step, name="encoder")(position)
        rate = (counts - UnitDelay(initial_value=0.0, name="last")(counts)) / T
        smooth = UnitDelay(initial_value=0.0, name="smooth")
        return smooth(keep * smooth.y + (1 - keep) * rate).named("speed")

    position = Sine(amplitude=1.0, frequency=1.0, name="position")
    run = Diagram("sensor", speed(position)).simulate(1.0, progress=False)
    last, smooth, rows = 0.0, 0.0, []
    for x in np.sin(2 * np.pi * run.t):
        counts = step * math.floor(x / step + 0.5)
        rows.append(smooth)
        smooth, last = keep * smooth + (1 - keep) * (counts - last) / T, counts
    assert np.max(np.abs(run["speed"] - rows)) < 1e-9


# --- delays ----------------------------------------------------------------------------------------------------------


def test_a_delay_equation_is_the_polynomials_of_the_method_of_steps():
    """x' = −x(t − 1), x = 1 before 0: on [n − 1, n] x is Σ (−1)^k (t − k + 1)^k / k!."""
    late = TransportDelay(delay=1.0, initial_value=1.0, name="late")
    x = Integrator(initial_value=1.0, name="x")
    run = Diagram("delay", x(-late(x.y))).simulate(6.0, step=0.05, **TIGHT)
    exact = [sum((-1) ** k * max(t - k + 1, 0.0) ** k / math.factorial(k) for k in range(int(t) + 2)) for t in run.t]
    assert np.max(np.abs(run["x.y"] - exact)) < 1e-8


def test_a_delayed_logistic_growth_is_that_of_scipy_piece_by_piece():
    """N' = r N (1 − N(t − τ)): SciPy with the dense output of the piece before."""
    r, tau = 1.8, 1.0
    late = TransportDelay(delay=tau, initial_value=0.5, name="late")
    n = Integrator(initial_value=0.5, name="n")
    run = Diagram("hutchinson", n(r * n.y * (1.0 - late(n.y)))).simulate(10.0, step=0.1, **TIGHT)

    def before(t):
        return [0.5]

    y, rows = 0.5, [0.5]
    for i in range(10):
        piece = solve_ivp(
            lambda t, y, past: r * y * (1 - past(t - tau)[0]),
            (i, i + 1.0),
            [y],
            "DOP853",
            args=(before,),
            rtol=1e-13,
            atol=1e-14,
            dense_output=True,
        )
        rows += list(piece.sol(i + 0.1 * np.arange(1, 11))[0])
        y, before = piece.y[0, -1], piece.sol
    assert np.max(np.abs(run["n.y"] - rows)) < 1e-7
    assert np.max(rows) > 2.0 > 0.4 > np.min(rows[50:])  # the limit cycle
