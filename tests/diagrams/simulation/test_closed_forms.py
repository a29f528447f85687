"""Known hard cases of hybrid simulation, against closed forms, matrix exponentials and SciPy at tight tolerance."""

import re

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq

from loopwright.blocks import (
    PID,
    Block,
    Compare,
    Constant,
    Event,
    Input,
    Integrator,
    Product,
    Ramp,
    Relay,
    ResettableIntegrator,
    SimulationError,
    Sine,
    State,
    StateSpace,
    Step,
    Sum,
    TransferFunction,
    TransportDelay,
    UnitDelay,
    parameter,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus.models.dc_motor import DcMotor
from support.hybrid_blocks import TIGHT, Ball

# --- bouncing ball -----------------------------------------------------------------------------------------------------


@pytest.mark.drawn(1)
@pytest.mark.parametrize("solver", ["DOP853", "RK45", "Radau", "auto"])
def test_a_bouncing_ball_meets_its_first_twenty_bounces_and_then_its_zeno_point(solver):
    e, g = 0.8, 9.81
    with pytest.raises(SimulationError, match=r"^ball, .*'impact' shows Zeno behaviour.*a state of rest") as caught:
        Diagram("ball", Ball(restitution=e, name="ball")).simulate(
            10.0, step=0.01, solver=solver, rtol=1e-10, atol=1e-12, progress=False
        )
    first, k = np.sqrt(2 / g), np.arange(20)
    speeds = g * first * e ** (k + 1)  # after each bounce
    times = first + 2 * first * np.concatenate([[0], np.cumsum(e ** k[1:])])
    bounces = caught.value.run.events[:20]
    assert np.max(np.abs([b.t for b in bounces] - times)) < 1e-9
    heights = np.array([b.after["velocity"] for b in bounces]) ** 2 / (2 * g)  # that it rises to
    assert np.max(np.abs(heights - speeds**2 / (2 * g))) < 1e-9
    end = first * (1 + e) / (1 - e)
    assert float(re.search(r"before t = ([\d.]+) s", str(caught.value)).group(1)) == pytest.approx(end, abs=2e-8)
    assert end - 1e-5 < caught.value.run.events[-1].t < end

    t, y = caught.value.run.t, caught.value.run["ball.height"]
    now = np.searchsorted(times, t, side="right") - 1
    inside = (t >= first) & (t < times[-1])
    tau, v = t[inside] - times[now[inside]], speeds[now[inside]]
    assert np.max(np.abs(y[inside] - (v * tau - g * tau**2 / 2))) < 1e-9


# --- thermostat --------------------------------------------------------------------------------------------------------


def test_a_thermostat_with_hysteresis_switches_where_its_exponentials_meet_the_points():
    """τ Ṫ = −T + 40 on; on below 19, off from 21 on."""
    tau, gain, low, high = 50.0, 40.0, 19.0, 21.0
    room = TransferFunction(numerator=gain, denominator=[tau, 1.0], name="room")
    heater = Relay(on_point=-low, off_point=-high, name="heater")
    run = Diagram("thermostat", room(heater(-1.0 * room.y).named("on")).named("T")).simulate(
        200.0, step=0.5, **{**TIGHT, "rtol": 1e-13}
    )

    def duration(a, b, target):
        return tau * np.log((target - a) / (target - b))

    up, down = duration(low, high, gain), duration(high, low, 0.0)
    times = duration(0.0, high, gain) + np.concatenate([[0.0], np.cumsum([down, up] * 20)])
    found = [e.t for e in run.events]
    assert len(found) == np.sum(times < 200.0) >= 20
    assert np.max(np.abs(found - times[: len(found)])) < 1e-9
    k = np.searchsorted(times, run.t, side="right")
    start = np.concatenate([[0.0], [high, low] * 20])[k]
    target, since = np.where(k % 2, 0.0, gain), run.t - np.concatenate([[0.0], times])[k]
    assert np.max(np.abs(run["T"] - (target + (start - target) * np.exp(-since / tau)))) < 1e-9
    assert np.array_equal(run["on"], 1.0 - k % 2)


# --- dry friction ------------------------------------------------------------------------------------------------------


class DryFriction(Block):
    """A mass with Coulomb friction on a belt: it sticks, slips to the right (1), or to the left (−1)."""

    mass: float = parameter(default=1.0)
    coulomb: float = parameter(default=1.0)
    static: float = parameter(default=1.5)
    stiffness: float = parameter(default=0.0)
    belt: float = parameter(default=0.0)
    force = Input()
    x = State(output=True)
    v = State(output=True, start="belt")
    mode = State(discrete=True, output=True)
    right = Event("rising", "static friction gives way to the right")
    left = Event("rising", "static friction gives way to the left")
    stop = Event("rising", "the mass comes to rest on the belt")

    def driving(self, x, u):
        return u.force - self.stiffness * x.x

    def derivative(self, t, x, u):
        slips = np.abs(x.mode) > 0.5
        return x.v, np.where(slips, (self.driving(x, u) - self.coulomb * x.mode) / self.mass, 0.0)

    def indicators(self, t, x, u):
        sticks, force = np.abs(x.mode) < 0.5, self.driving(x, u)
        return (
            np.where(sticks, force - self.static, -1.0),
            np.where(sticks, -force - self.static, -1.0),
            np.where(sticks, -1.0, -(x.v - self.belt) * x.mode),
        )

    def jump(self, t, x, u, fired):
        mode = np.where(fired.right > 0.5, 1.0, np.where(fired.left > 0.5, -1.0, 0.0))
        return x.x, np.where(fired.stop > 0.5, self.belt + 0.0 * x.v, x.v), mode


@pytest.mark.slow
@pytest.mark.parametrize("duration", [20.0, pytest.param(60.0, marks=pytest.mark.slow)])
def test_stick_slip_on_a_belt_has_the_period_of_its_closed_form(duration):
    m, k, vb, Fs, Fc = 1.0, 4.0, 0.1, 1.5, 1.0
    mass = DryFriction(mass=m, coulomb=Fc, static=Fs, stiffness=k, belt=vb, name="mass")
    run = Diagram("belt", mass(Constant(value=0.0))).simulate(duration, step=0.01, **TIGHT)
    w = np.sqrt(k / m)
    slip = 2 * (np.pi - np.arctan((Fs - Fc) * w / (k * vb))) / w
    stick = 2 * (Fs - Fc) / (k * vb)
    first = Fs / (k * vb)
    times = first + np.concatenate([[0.0], np.cumsum([slip, stick] * 20)])
    assert [e.event for e in run.events] == (["left", "stop"] * 20)[: len(run.events)]
    assert len(run.events) == np.sum(times < duration) >= duration / 3
    assert np.max(np.abs([e.t for e in run.events] - times[: len(run.events)])) < 1e-9
    inside = (run.t > first) & (run.t < first + slip)
    tau = run.t[inside] - first
    exact = Fc / k + (Fs - Fc) / k * np.cos(w * tau) + vb / w * np.sin(w * tau)
    assert np.max(np.abs(run["mass.x"][inside] - exact)) < 1e-10


def forced(F, w, Fs, Fc, end):
    """Return the instants at which a mass of 1 under F sin ωt changes its mode, and the new modes."""
    t, mode, found = 0.0, 0, []
    while t < end:
        if mode == 0:  # waits until the force passes the static friction
            grid = t + np.linspace(1e-9, 2 * np.pi / w, 4001)
            beyond = np.abs(F * np.sin(w * grid)) > Fs
            if abs(F * np.sin(w * t)) > Fs:
                mode = int(np.sign(np.sin(w * t)))
            else:
                i = int(np.argmax(beyond))
                t = brentq(lambda s: abs(F * np.sin(w * s)) - Fs, grid[i - 1], grid[i], xtol=1e-15)
                mode = int(np.sign(np.sin(w * t)))
        else:

            def speed(s, t=t, mode=mode):
                return -F / w * (np.cos(w * s) - np.cos(w * t)) - Fc * mode * (s - t)

            grid = t + np.linspace(1e-3, 4 * np.pi / w, 8001)
            i = int(np.argmax(mode * speed(grid) < 0))
            t, mode = brentq(speed, grid[i - 1], grid[i], xtol=1e-15), 0
        found.append((t, mode))
    return [(t, m) for t, m in found if t < end]


@pytest.mark.slow
@pytest.mark.parametrize(("F", "sticks"), [(2.0, True), (6.0, False)])
def test_a_mass_that_is_pushed_to_and_fro_sticks_and_slips_both_ways(F, sticks):
    """With the larger force it never rests: where it stops, it slips back at the same instant."""
    w, Fs, Fc = 2.0, 1.5, 1.0
    wave = Sine(amplitude=F, frequency=w / (2 * np.pi))
    run = Diagram("push", DryFriction(static=Fs, coulomb=Fc, name="mass")(wave)).simulate(20.0, step=0.01, **TIGHT)
    expected = forced(F, w, Fs, Fc, 20.0)
    names = {1: "right", -1: "left", 0: "stop"}
    assert [e.event for e in run.events] == [names[m] for _, m in expected]
    assert {e.event for e in run.events} == {"right", "left", "stop"}
    assert np.max(np.abs([e.t for e in run.events] - np.array([t for t, _ in expected]))) < 1e-9
    assert len(run.events) > 20
    assert bool(np.any(run["mass.mode"][run.t > 2.0] == 0.0)) is sticks


# --- stiffness ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def van_der_pol():
    """Its solution by SciPy at sampled times, and when x crosses zero."""
    mu = 1000.0

    def crosses(t, s):
        return s[0]

    return solve_ivp(
        lambda t, s: [s[1], mu * (1 - s[0] ** 2) * s[1] - s[0]],
        (0.0, 2000.0),
        [2.0, 0.0],
        method="Radau",
        rtol=1e-12,
        atol=1e-14,
        t_eval=np.linspace(0.0, 2000.0, 41),
        events=crosses,
        jac=lambda t, s: [[0.0, 1.0], [-2 * mu * s[0] * s[1] - 1, mu * (1 - s[0] ** 2)]],
    )


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["auto", "BDF", "Radau", "CVODE_BDF"])
def test_a_stiff_van_der_pol_oscillator_of_single_blocks_jumps_when_scipy_says(solver, van_der_pol):
    """ẍ = μ (1 − x²) ẋ − x, μ = 1000: the time of each jump, and the state between them."""
    x, v = Integrator(initial_value=2.0, name="x"), Integrator(initial_value=0.0, name="v")
    damping = Product(name="damping")(1.0 - Product(name="square")(x.y, x.y), v.y)
    after = Compare("<", name="jumped")(x(v.y), 0.0)
    errors = []
    for rtol in (1e-5, 1e-8):
        run = Diagram("vdp", v(1000.0 * damping - x.y), after).simulate(
            2000.0, step=50.0, solver=solver, rtol=rtol, atol=1e-2 * rtol, progress=False
        )
        assert len(run.events) == 2
        times = np.max(np.abs([e.t for e in run.events] / van_der_pol.t_events[0] - 1))
        errors.append((times, np.max(np.abs(run["x.y"] - van_der_pol.y[0]))))
    (coarse, _), (fine, state) = errors
    assert coarse < 1e-3
    assert fine < min(5e-6, coarse / 20)  # a tolerance a thousand times smaller, at order 2 at least
    assert state < 4e-5


# --- a drive -----------------------------------------------------------------------------------------------------------

MOTOR = DcMotor()
CURRENT = {"kp": 0.8, "ki": 400.0, "lower": -24.0, "upper": 24.0}  # V
SPEED = {"kp": 0.04, "ki": 1.2, "lower": -4.0, "upper": 4.0}  # A
SET_POINT, LOAD, WHEN = 250.0, 0.05, 0.15  # rad/s, N m, s


def drive(anti_windup="back_calculation"):
    motor = MOTOR.replace(name="motor")
    way = {"anti_windup": anti_windup}

    @subsystem(sample_time=1e-3)
    def speed_loop(speed):
        return PID(**SPEED, **way, name="pi")(Constant(value=SET_POINT), speed)

    @subsystem(sample_time=1e-4)
    def current_loop(wanted, current):
        return PID(**CURRENT, **way, name="pi")(wanted, current)

    voltage = current_loop(speed_loop(motor.speed), motor.current)
    return Diagram("drive", motor(voltage, Step(times=WHEN, values=LOAD)))


def motor_matrices():
    m = MOTOR
    A = np.array(
        [
            [-m.resistance / m.inductance, -m.motor_constant / m.inductance, 0],
            [m.motor_constant / m.inertia, -m.friction / m.inertia, 0],
            [0, 1, 0],
        ]
    )
    return A, np.array([[1 / m.inductance, 0], [0, -1 / m.inertia], [0, 0]])


class PI:
    """A PI controller by hand, in steps of T or ideal."""

    def __init__(self, kp, ki, lower, upper, clamping=False):
        self.kp, self.ki, self.lower, self.upper, self.clamping = kp, ki, lower, upper, clamping

    def output(self, e, integral):
        v = self.kp * e + integral
        return min(max(v, self.lower), self.upper), v

    def step(self, e, integral, T):
        u, v = self.output(e, integral)
        if self.clamping:
            held = (v > self.upper and e > 0) or (v < self.lower and e < 0)
            return integral + (0.0 if held else T * self.ki * e)
        return integral + T * self.ki * e + (1 - np.exp(-T * self.ki / self.kp)) * (u - v)


@pytest.mark.slow
@pytest.mark.drawn(1)
@pytest.mark.parametrize("anti_windup", ["back_calculation", "clamping"])
def test_a_cascade_of_pi_controllers_in_two_rates_is_its_recursion_by_hand(anti_windup):
    run = drive(anti_windup).simulate(0.3, **TIGHT)
    clamping = anti_windup == "clamping"
    inner, outer = PI(**CURRENT, clamping=clamping), PI(**SPEED, clamping=clamping)
    A, B = motor_matrices()
    phi = expm(np.block([[A, B], [np.zeros((2, 5))]]) * 1e-4)
    x, z, w, expected, saturated = np.zeros(3), 0.0, 0.0, [], 0
    for k in range(3001):
        if k % 10 == 0:
            e = SET_POINT - x[1]
            wanted, v = outer.output(e, w)
            saturated += wanted != v
            w = outer.step(e, w, 1e-3)
        u, _ = inner.output(wanted - x[0], z)
        expected.append([*x, u, wanted])
        z = inner.step(wanted - x[0], z, 1e-4)
        x = (phi @ [*x, u, LOAD if k >= 1500 else 0.0])[:3]
    assert saturated > 20
    assert abs(x[1] - SET_POINT) < 5.0
    found = np.stack(
        [run[n] for n in ("motor.current", "motor.speed", "motor.angle", "current_loop.pi.u", "speed_loop.pi.u")], 1
    )
    size = np.max(np.abs(expected), axis=0)
    assert len(run.t) == 3001
    assert np.max(np.abs(found - expected) / size) < 1e-10


@pytest.mark.slow
def test_the_ideal_cascade_is_what_scipy_makes_of_its_equations():
    run = drive().continuous().simulate(0.3, step=1e-3, solver="Radau", rtol=1e-10, atol=1e-11, progress=False)
    inner, outer = PI(**CURRENT), PI(**SPEED)
    A, B = motor_matrices()

    def rates(t, s, load):
        e = SET_POINT - s[1]
        wanted, v = outer.output(e, s[4])
        u, w = inner.output(wanted - s[0], s[3])
        dI = inner.ki * (wanted - s[0]) + inner.ki / inner.kp * (u - w)
        return [*(A @ s[:3] + B @ [u, load]), dI, outer.ki * e + outer.ki / outer.kp * (wanted - v)]

    options = {"method": "LSODA", "rtol": 1e-12, "atol": 1e-13, "dense_output": True}
    first = solve_ivp(rates, (0.0, WHEN), np.zeros(5), args=(0.0,), **options)
    second = solve_ivp(rates, (WHEN, 0.3), first.y[:, -1], args=(LOAD,), **options)
    exact = np.where(run.t < WHEN, first.sol(run.t), second.sol(run.t))
    assert np.max(run["speed_loop.pi.excess"]) > 1.0
    for name, row in (("motor.current", 0), ("motor.speed", 1), ("motor.angle", 2)):
        assert np.max(np.abs(run[name] - exact[row])) < 1e-7 * np.max(np.abs(exact[row]))


# --- reset -------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_integrator_that_resets_itself_fires_at_the_roots_of_its_closed_form():
    """ẏ = t, back to zero from 1: the k-th time at √(2 k)."""
    y = ResettableIntegrator(name="i")
    full = Compare(">", name="full")(y.y, 1.0)
    run = Diagram("fire", y(Ramp(slope=1.0), full)).simulate(10.0, step=0.01, **TIGHT)
    fired = [e.t for e in run.events if e.event == "restart"]
    assert len(fired) in (49, 50)  # the fiftieth is due at the end, t = 10: the tolerance says on which side
    assert np.max(np.abs(fired - np.sqrt(2 * np.arange(1, len(fired) + 1)))) < 1e-10
    count = np.searchsorted(fired, run.t[:-1], side="right")
    assert np.max(np.abs(run["i.y"][:-1] - (run.t[:-1] ** 2 / 2 - count))) < 1e-9


# --- delay -------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_delay_that_is_no_multiple_of_the_sample_time_in_a_sampled_loop():
    """The held control signal reaches the plant a delay of 2.35 samples late: a matrix exponential for each piece."""
    A, B = np.array([[0.0, 1.0], [-2.0, -0.8]]), np.array([0.0, 2.0])
    T, tau, n = 0.1, 0.235, 100
    plant = StateSpace(A=A, B=B, C=[1.0, 0.0], name="plant")

    @subsystem(sample_time=T)
    def control(y):
        integral, e = UnitDelay(initial_value=0.0, name="integral"), 1.0 - y
        total = Sum(name="total")(integral.y, 0.05 * e)
        integral(total)
        return (0.4 * e + integral.y).named("u")

    late = TransportDelay(delay=tau, name="late")
    run = Diagram("loop", plant(late(control(plant.y)))).simulate(n * T, **TIGHT)

    def pass_by(x, u, h):
        return (expm(np.block([[A, B[:, None]], [np.zeros((1, 3))]]) * h) @ [*x, u])[:2]

    x, integral, sent, expected = np.zeros(2), 0.0, [0.0, 0.0, 0.0], []
    for _ in range(n + 1):
        e = 1.0 - x[0]
        sent.append(0.4 * e + integral)
        integral += 0.05 * e
        expected.append((x[0], sent[-1]))
        x = pass_by(x, sent[-4], 0.035)  # until 0.35 of the sample time what left three samples ago arrives
        x = pass_by(x, sent[-3], 0.065)
    assert abs(x[0] - 1.0) < 0.05
    assert np.max(np.abs(np.stack([run["plant.y"], run["u"]], 1) - expected)) < 1e-10
