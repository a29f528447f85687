"""Margins of fast loops in slow ones: the oracle is the period, gone through by hand with matrix exponentials."""

import sys

import control
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from loopwright.blocks import PID, Constant, Gain, OptionError, ParameterError, TransferFunction
from loopwright.diagrams import ConfirmationError, Diagram, PeriodicLoopError, subsystem
from loopwright.diagrams.frequency.sensitivity_peaks import sensitivity_at
from loopwright.frequency import disk_margin, margins, periodic_margins
from support.loops import open_loops
from support.random_cases import random_cases

FAST, MIDDLE, SLOW = 0.002, 0.006, 0.03
CURRENT, SPEED, ANGLE = (2.0, 60.0), (2.0, 3.0), 4.0
"""Gains kp and ki of the current and the speed controller, and of the controller of the angle."""
A = np.array([[-50.0, 0.0, 0.0], [5.0, -0.2, 0.0], [0.0, 1.0, 0.0]])
B = np.array([[50.0], [0.0], [0.0]])


def servo():
    """Return a current loop in a speed loop in a loop of the angle, each at a rate of its own."""
    electric = TransferFunction(numerator=[1.0], denominator=[0.02, 1.0], name="electric")
    mechanic = TransferFunction(numerator=[5.0], denominator=[1.0, 0.2], name="mechanic")
    turning = TransferFunction(numerator=[1.0], denominator=[1.0, 0.0], name="turning")

    @subsystem(sample_time=SLOW)
    def angle_loop(r, y):
        return Gain(gain=ANGLE, name="k")(r - y).named("speed_reference")

    @subsystem(sample_time=MIDDLE)
    def speed_loop(r, y):
        return PID(kp=SPEED[0], ki=SPEED[1])(r, y).named("reference")

    @subsystem(sample_time=FAST)
    def current_loop(r, y):
        return PID(kp=CURRENT[0], ki=CURRENT[1])(r, y).named("voltage")

    reference = speed_loop(angle_loop(Constant(value=0.0), turning.y), mechanic.y)
    return Diagram("servo", turning(mechanic(electric(current_loop(reference, electric.y)))))


def monodromy(wire="voltage", factor=1.0, delay=0, frozen=()):
    """Return the matrix over a period of the servo, with a factor and renewals of delay on a wire, gone through by hand.

    Parameters
    ----------
    frozen : tuple of str
        Loops that hold their outputs: "angle", "speed".
    """
    whole = expm(np.block([[A, B], [np.zeros((1, 4))]]) * FAST)
    Phi, Gamma = whole[:3, :3], whole[:3, 3]
    ticks = [round(T / FAST) for T in (FAST, MIDDLE, SLOW) if not (T == SLOW and "angle" in frozen)]
    ticks = [t for t in ticks if not (t == round(MIDDLE / FAST) and "speed" in frozen)]
    size = 3 + 2 + 2 + delay  # plant, integrals, held references, the delay line

    def go(state):
        x, (i_current, i_speed), (speed_ref, current_ref) = state[:3], state[3:5], state[5:7]
        line = list(state[7:])
        for k in range(np.lcm.reduce(ticks)):
            if k % round(SLOW / FAST) == 0 and "angle" not in frozen:
                speed_ref = -ANGLE * x[2]
            if k % round(MIDDLE / FAST) == 0 and "speed" not in frozen:
                e = speed_ref - x[1]
                made, i_speed = SPEED[0] * e + i_speed, i_speed + MIDDLE * SPEED[1] * e
                if wire == "reference":
                    line.append(made)
                    made = factor * line.pop(0)
                current_ref = made
            e = current_ref - x[0]
            v, i_current = CURRENT[0] * e + i_current, i_current + FAST * CURRENT[1] * e
            if wire == "voltage":
                line.append(v)
                v = factor * line.pop(0)
            x = Phi @ x + Gamma * v
        return np.concatenate([x, [i_current, i_speed, speed_ref, current_ref], line])

    M = np.array([go(column) for column in np.eye(size, dtype=complex)]).T
    # references that nobody renews are constants, and the angle and the integral that nobody reads are no part of a loop
    gone = [i for i, name in ((2, "angle"), (5, "angle"), (4, "speed"), (6, "speed")) if name in frozen]
    keep = [i for i in range(size) if i not in gone]
    return M[np.ix_(keep, keep)]


def radius(**changes):
    return float(np.max(np.abs(np.linalg.eigvals(monodromy(**changes)))))


@pytest.fixture(scope="module")
def model():
    return servo().linearize()


@pytest.mark.parametrize("wire", ["voltage", "reference"])
@pytest.mark.slow
def test_gain_phase_and_delay_margins_are_the_limits_of_the_period_gone_through_by_hand(model, wire):
    L = model.loop(wire, lifted=True)
    found = periodic_margins(L)
    assert found.renewals == L.ninputs == {"voltage": 15, "reference": 5}[wire]
    assert found.dt == pytest.approx(SLOW)
    poles = np.linalg.eigvals(monodromy(wire))
    for p in found.closed_loop_poles:
        assert np.min(np.abs(poles - p)) < 1e-8
    high = found.gain_margin_high.value
    assert high == pytest.approx(brentq(lambda k: radius(wire=wire, factor=k) - 1, 1.0, 1.5 * high), rel=1e-8)
    low = found.gain_margin_low.value
    assert low == pytest.approx(brentq(lambda k: radius(wire=wire, factor=k) - 1, 0.5 * low, 1.0), rel=1e-6)
    phase = np.radians(found.phase_margin_deg.value)
    turned = brentq(lambda a: radius(wire=wire, factor=np.exp(1j * a)) - 1, 0.5 * phase, 1.2 * phase)
    assert phase == pytest.approx(turned, rel=1e-7)
    n = int(found.delay_margin_samples.value)
    assert n > 0
    assert [radius(wire=wire, delay=k) < 1 for k in (*range(n + 1), n + 1)] == [True] * (n + 1) + [False]
    assert found.delay_margin_s.value == pytest.approx(n * SLOW / found.renewals)
    assert all(number.confirmed_by for number in found.numbers().values())


@pytest.mark.slow
@pytest.mark.parametrize("wire", ["voltage", "reference"])
def test_the_disk_margin_is_the_smallest_disk_that_destabilizes_the_period_gone_through_by_hand(model, wire):
    found = periodic_margins(model.loop(wire, lifted=True))

    def beyond(size, turn):
        d = size * np.exp(1j * turn)
        return radius(wire=wire, factor=(1 + d / 2) / (1 - d / 2)) - 1

    alpha = found.disk_margin.value
    assert max(beyond(0.9999 * alpha, turn) for turn in np.linspace(0, np.pi, 60)) < 0
    d = 2 * (found.destabilizing - 1) / (found.destabilizing + 1)
    assert abs(d) == pytest.approx(alpha, rel=1e-9)
    assert brentq(beyond, 0.9 * alpha, 1.1 * alpha, args=(np.angle(d),)) == pytest.approx(alpha, rel=1e-6)
    nearest = np.linalg.eigvals(monodromy(wire, found.destabilizing))
    z = np.exp(1j * found.disk_frequency.value * SLOW)
    assert np.min(np.minimum(np.abs(nearest - z), np.abs(nearest - z.conj()))) < 1e-5


@pytest.mark.drawn(1)
@pytest.mark.parametrize(
    ("wire", "frozen", "dt"), [("voltage", ("angle", "speed"), FAST), ("reference", ("angle",), MIDDLE)]
)
def test_with_slow_loops_open_a_loop_has_its_own_rate_and_the_limits_of_the_open_period(model, wire, frozen, dt):
    L = model.loop(wire, slow="open")
    assert (L.ninputs, L.dt) == (1, pytest.approx(dt))
    m = margins(L)
    high = m.gain_margin_high.value
    found = brentq(lambda k: radius(wire=wire, factor=k, frozen=frozen) - 1, 1.1, 1.5 * high)
    assert high == pytest.approx(found, rel=1e-9)
    n = int(m.delay_margin_samples.value)
    assert [radius(wire=wire, delay=k, frozen=frozen) < 1 for k in (n, n + 1)] == [True, False]
    s = m.phase_margin_deg.value
    turned = brentq(
        lambda a: radius(wire=wire, factor=np.exp(-1j * np.radians(a)), frozen=frozen) - 1, 0.5 * s, min(1.2 * s, 179)
    )
    assert s == pytest.approx(turned, rel=1e-7)


def test_the_current_loop_alone_is_that_of_its_transfer_function(model):
    # electric part behind a hold: a pole at e^(−T/τ); the controller kp + ki T/(z − 1)
    z = np.exp(1j * np.array([3.0, 40.0, 700.0]) * FAST)
    a, (kp, ki) = np.exp(-FAST / 0.02), CURRENT
    exact = (kp + ki * FAST / (z - 1)) * (1 - a) / (z - a)
    assert model.loop("voltage", slow="open")(z) == pytest.approx(exact, rel=1e-10)


def test_the_slowest_loop_is_the_same_open_and_closed(model):
    z = np.exp(0.3j)
    L = model.loop("speed_reference")
    assert model.loop("speed_reference", slow="open")(z) == pytest.approx(L(z), rel=1e-12)


def test_a_periodic_loop_is_refused_with_both_ways_on(model):
    with pytest.raises(PeriodicLoopError, match=r"renewed 15 times .*slow='open'.*periodic_margins\(loop\('voltage'"):
        model.loop("voltage")


@pytest.mark.slow
@random_cases(4, 60, open_loops(sampled=True), reaching=0.1)
def test_a_loop_with_one_renewal_has_the_margins_of_any_sampled_loop(loop):
    plain = margins(loop)
    found = periodic_margins(loop)
    assert found.stable == plain.stable
    if not plain.stable or plain.gain_margin_high.value > 1e3:
        return False
    assert found.gain_margin_high.value == pytest.approx(plain.gain_margin_high.value, rel=1e-6)
    assert found.disk_margin.value == pytest.approx(disk_margin(loop).alpha.value, rel=1e-6)
    assert found.phase_margin_deg.value == pytest.approx(plain.phase_margin_deg.value, rel=1e-6)
    assert found.ms.value == pytest.approx(plain.ms.value, rel=1e-6)
    assert found.mt.value == pytest.approx(plain.mt.value, rel=1e-6)
    return True


def unlifted(gain):
    """Return an integrator x⁺ = x + gain u that is renewed twice in the period."""
    return control.ss([[1.0]], [[gain, gain]], [[1.0], [1.0]], [[0.0, 0.0], [gain, 0.0]], 0.2)


def test_an_integrator_that_is_renewed_twice_is_that_integrator():
    # x⁺ = (1 − k g) x: stable for 0 < k g < 2; f = e^(jφ): |1 − g f| = 1 where cos φ = g/2
    found = periodic_margins(unlifted(0.4))
    assert found.gain_margin_high.value == pytest.approx(2 / 0.4, rel=1e-9)
    assert found.gain_margin_low.value == 0.0
    assert found.phase_margin_deg.value == pytest.approx(np.degrees(np.arccos(0.2)), rel=1e-9)
    one = disk_margin(control.ss([[1.0]], [[0.4]], [[1.0]], [[0.0]], 0.1)).alpha.value
    assert found.disk_margin.value == pytest.approx(one, rel=1e-9)


def test_an_integrator_with_a_small_gain_has_margins():
    # x⁺ = x + T u: it bears 2/T, and a phase of arccos(T/2); its delay is beyond what is looked for
    T = 0.005
    found = periodic_margins(control.ss([[1.0]], [[T]], [[1.0]], [[0.0]], T))
    assert found.gain_margin_high.value == pytest.approx(2 / T, rel=1e-9)
    assert found.phase_margin_deg.value == pytest.approx(np.degrees(np.arccos(T / 2)), rel=1e-9)
    assert np.isnan(found.delay_margin_s.value)


def test_a_loop_with_a_pole_at_zero_has_margins():
    """0.4/(z (z − 1)): z² − z + k is stable for 0 < k < 1."""
    found = periodic_margins(control.ss([[1.0, 0.0], [1.0, 0.0]], [[1.0], [0.0]], [[0.0, 0.4]], [[0.0]], 0.1))
    assert found.gain_margin_high.value == pytest.approx(2.5, rel=1e-9)


def test_an_unstable_periodic_loop_says_so_with_its_poles():
    found = periodic_margins(unlifted(3.0))
    assert not found.stable
    assert all(np.isnan(n.value) for n in found.numbers().values())
    assert "none, as the closed loop is unstable" in str(found).splitlines()[0]
    assert "z = 4+0j" in str(found)  # (1 − 3)²
    assert found.unstable_poles == pytest.approx((4.0,))


def test_a_small_gain_bears_any_delay():
    loop = control.ss([[0.5]], [[0.1, 0.1]], [[0.2], [0.2]], np.zeros((2, 2)), 0.2)
    found = periodic_margins(loop)
    assert found.delay_margin_samples.value == found.delay_margin_s.value == np.inf


@pytest.mark.parametrize(
    ("loop", "message"),
    [
        (control.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]]), "dt = 0 and 1 states"),
        (control.ss([[0.5]], [[1.0, 1.0]], [[1.0]], [[0.0, 0.0]], 0.1), r"shape \(1, 2\)"),
        (control.ss([[0.5]], [[1.0]], [[1.0]], [[-1.0]], 0.1), "unique solution"),
        (control.ss([[0.5]], [[1.0, 1.0]], [[1.0], [1.0]], np.zeros((2, 2)), 0.1, inputs=["a@0", "b@0"]), "2 wires"),
    ],
    ids=["continuous", "not square", "no solution", "two wires"],
)
def test_other_loops_are_refused(loop, message):
    with pytest.raises(ParameterError, match=message):
        periodic_margins(loop)


def test_another_way_to_open_slow_loops_is_refused(model):
    with pytest.raises(OptionError, match="found slow='off'"):
        model.loop("voltage", slow="off")


def test_slower_loops_need_a_clock_at_the_wire():
    lag = TransferFunction(numerator=[1.0], denominator=[1.0, 1.0], name="lag")
    with pytest.raises(OptionError, match="no sampled subsystem"):
        Diagram("lag", lag((-1.0 * lag.y).named("u"))).linearize().loop("u", slow="open")


@pytest.mark.slow
def test_a_disk_that_is_too_large_is_not_confirmed(monkeypatch, model):
    L = model.loop("voltage", lifted=True)
    nearer = lambda r, omega: 0.25 * np.eye(len(r.D)) + sensitivity_at(r, omega) / 2  # noqa: E731
    monkeypatch.setattr(sys.modules["loopwright.diagrams.frequency.periodic_margins"], "sensitivity_at", nearer)
    with pytest.raises(ConfirmationError, match="factors just inside"):
        periodic_margins(L)


@pytest.mark.parametrize("gains", [(0.4, 0.4), (0.3, 1.2)])
@pytest.mark.drawn(1)
def test_ms_of_a_periodic_loop_is_the_largest_gain_of_the_renewals_gone_through_by_hand(gains):
    """x⁺ = x + g u with two gains in turn, u = d − x: the norm of the matrix from 600 values of d to those of u and x."""
    first, second = gains
    D = [[0.0, 0.0], [first, 0.0]]
    found = periodic_margins(control.ss([[1.0]], [[first, second]], [[1.0], [1.0]], D, 0.2))
    count = 600
    x, rows = np.zeros(count), []
    for k in range(count):
        rows.append(x)
        x = x + gains[k % 2] * (np.eye(count)[k] - x)
    T = np.array(rows)
    S = np.eye(count) - T
    assert found.ms.value == pytest.approx(np.linalg.norm(S, 2), rel=2e-4)  # a finite record's is less
    assert found.ms.value >= np.linalg.norm(S, 2) - 1e-9
    assert found.mt.value == pytest.approx(np.linalg.norm(T, 2), rel=2e-4)
    assert found.modulus_margin.value == pytest.approx(1 / found.ms.value, rel=1e-12)
    if first == second:  # S = (z − 1)/(z − 0.6), which is largest at z = −1
        assert found.ms.value == pytest.approx(2 / 1.6, rel=1e-9)
