"""Loops with dead time in continuous time: margins against closed forms, stability against Lambert's W and roots.

The oracles take L as a formula in e^(−sτ), and nothing of the linear model.
"""

import itertools

import control
import mpmath
import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar
from scipy.special import lambertw

from loopwright.blocks import PID, Constant, Gain, Integrator, OptionError, Sum, TransferFunction, TransportDelay
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.frequency.delay_matrices import DelayMatrices
from loopwright.diagrams.frequency.delayed_realization import DelayedRealization, realize
from loopwright.diagrams.frequency.delayed_system import DelayedSystem
from loopwright.diagrams.frequency.loop_margins import scan_margins
from loopwright.diagrams.frequency.loop_scan import LoopScan
from loopwright.frequency import disk_margin, margins, nyquist_count
from loopwright.types import LinearDelays


def rational(numerator, denominator, name):
    return TransferFunction(numerator=numerator, denominator=denominator, name=name)


def delay(tau, name="late"):
    return TransportDelay(delay=tau, name=name)


def error(y):
    return Sum(signs="+-", name="e")(Constant(value=0.0, name="r"), y)


def pi(y, kp, ki):
    return rational([kp, ki], [1.0, 0.0], "pi")(error(y)).named("u")


def one_lag():
    """PI, a lag of 5 s and 1 s of dead time."""
    plant = rational([2.0], [5.0, 1.0], "lag")
    L = lambda s: (1 + 0.25 / s) * 2 * np.exp(-s) / (5 * s + 1)  # noqa: E731
    return Diagram("d", plant(delay(1.0)(pi(plant.y, 1.0, 0.25)))), L, (0.1, 1.0, 3.0)


def integrating():
    """K e^(−sτ)/s: phase margin 90° − K τ 180°/π, gain margin π/(2 K τ)."""
    plant, late = Integrator(name="tank"), delay(0.8)
    u = Gain(gain=0.7, name="k")(error(late.y)).named("u")
    return Diagram("d", late(plant(u))), lambda s: 0.7 * np.exp(-0.8 * s) / s, (0.1, 1.0, 3.0)


def integrating_with_pi():
    """A double integrator with dead time: gain margins to both sides."""
    plant, late = Integrator(name="tank"), delay(0.8)
    L = lambda s: (0.6 + 0.1 / s) * np.exp(-0.8 * s) / s  # noqa: E731
    return Diagram("d", late(plant(pi(late.y, 0.6, 0.1)))), L, (0.3, 1.0, 3.0)


def two_ways():
    """Two lags in parallel, with different dead times."""
    a, b = rational([1.0], [1.0, 1.0], "a"), rational([0.5], [2.0, 1.0], "b")
    both = Sum(signs="++", name="both")
    u = pi(both.y, 0.6, 0.5)
    L = lambda s: (0.6 + 0.5 / s) * (np.exp(-0.5 * s) / (s + 1) + 0.5 * np.exp(-1.3 * s) / (2 * s + 1))  # noqa: E731
    return Diagram("d", both(a(delay(0.5, "short")(u)), b(delay(1.3, "long")(u)))), L, (0.1, 0.6, 3.0)


def inner_loop():
    """A lag that is fed back with a dead time of its own, and another one ahead of it."""
    lag = rational([1.0], [1.0, 1.0], "lag")
    sum_of = Sum(signs="+-", name="inner")
    y = lag(sum_of(delay(0.4, "outer")(pi(lag.y, 0.8, 0.6)), Gain(gain=0.7, name="k")(delay(0.9, "back")(lag.y))))
    L = lambda s: (0.8 + 0.6 / s) * np.exp(-0.4 * s) / (s + 1 + 0.7 * np.exp(-0.9 * s))  # noqa: E731
    return Diagram("d", y), L, (0.1, 0.5, 3.0)


def smith_predictor():
    """A Smith predictor whose model has another dead time than the plant, at the plant's input."""
    plant, model = rational([2.0], [5.0, 1.0], "plant"), rational([2.0], [5.0, 1.0], "model")
    late, guess = delay(2.0, "late"), delay(2.3, "guess")
    feedback = Sum(signs="++-", name="feedback")
    c = rational([2.0, 0.5], [1.0, 0.0], "pi")(error(feedback(late.y, model.y, guess.y)))
    u = Gain(gain=1.0, name="valve")(c).named("u")
    known = model(c)

    def L(s):
        C, G = 2.0 + 0.5 / s, 2.0 / (5 * s + 1)
        return C * G * np.exp(-2.0 * s) / (1 + C * G * (1 - np.exp(-2.3 * s)))

    return Diagram("d", late(plant(u)), guess(known)), L, (0.05, 0.4, 3.0)


def unstable_plant():
    """1.5 e^(−0.3 s)/(s − 1)."""
    plant = rational([1.0], [1.0, -1.0], "plant")
    u = Gain(gain=1.5, name="k")(error(plant.y)).named("u")
    return Diagram("d", plant(delay(0.3)(u))), lambda s: 1.5 * np.exp(-0.3 * s) / (s - 1), (0.1, 1.0, 5.0)


def resonant():
    """A resonance of damping 0.05 that crosses |L| = 1 three times."""
    plant = rational([1.0], [1.0, 0.1, 1.0], "plant")
    L = lambda s: 0.2 / s * np.exp(-0.2 * s) / (s * s + 0.1 * s + 1)  # noqa: E731
    u = rational([0.05], [1.0, 0.0], "i")(error(plant.y)).named("u")
    return Diagram("d", plant(delay(0.2)(u))), lambda s: L(s) / 4, (0.01, 0.3, 1.02)


def tiny_delay():
    """A delay a million times as short as the lags."""
    plant = rational([3.0], [0.2, 1.2, 1.0], "plant")
    L = lambda s: (1 + 0.5 / s) * 3 * np.exp(-1e-6 * s) / (0.2 * s * s + 1.2 * s + 1)  # noqa: E731
    return Diagram("d", plant(delay(1e-6)(pi(plant.y, 1.0, 0.5)))), L, (0.3, 3.0, 5e3)


def long_delay():
    """17 s of dead time, and a lag of 5 s."""
    plant = rational([1.0], [5.0, 1.0], "plant")
    L = lambda s: (0.3 + 0.04 / s) * np.exp(-17 * s) / (5 * s + 1)  # noqa: E731
    return Diagram("d", plant(delay(17.0)(pi(plant.y, 0.3, 0.04)))), L, (0.003, 0.05, 0.2)


def filtered_pid():
    """A PID with a filtered derivative, and two lags."""
    plant = rational([1.0], [2.0, 3.0, 1.0], "plant")
    pid = rational([1.05 * 1.0 + 0.6, 1.0 + 0.05 * 0.5, 0.5], [0.05, 1.0, 0.0], "pid")
    C = lambda s: ((1.65 * s + 1.025) * s + 0.5) / (s * (0.05 * s + 1))  # noqa: E731
    u = pid(error(plant.y)).named("u")
    L = lambda s: C(s) * np.exp(-0.5 * s) / ((2 * s + 1) * (s + 1))  # noqa: E731
    return Diagram("d", plant(delay(0.5)(u))), L, (0.05, 1.0, 4.0)


def three_delays():
    """Three dead times in series with lags between them: only their sum counts."""
    a, b = rational([1.0], [1.0, 1.0], "a"), rational([2.0], [0.5, 1.0], "b")
    third = delay(0.3, "third")
    y = third(b(delay(0.2, "second")(a(delay(0.1, "first")(pi(third.y, 0.5, 0.4))))))
    L = lambda s: (0.5 + 0.4 / s) * 2 * np.exp(-0.6 * s) / ((s + 1) * (0.5 * s + 1))  # noqa: E731
    return Diagram("d", y), L, (0.1, 0.9, 4.0)


LOOPS = [
    one_lag,
    integrating,
    integrating_with_pi,
    two_ways,
    inner_loop,
    smith_predictor,
    unstable_plant,
    resonant,
    tiny_delay,
    long_delay,
    filtered_pid,
    three_delays,
]


def roots(function, w):
    """Return the sign changes of a function at frequencies, refined, where it does not jump."""
    values = function(w)
    at = np.flatnonzero(values[:-1] * values[1:] < 0)
    return np.array([brentq(lambda x: function(np.array([x]))[0], w[k], w[k + 1], xtol=1e-15, rtol=1e-14) for k in at])


@pytest.mark.drawn(1)
@pytest.mark.parametrize("make", LOOPS, ids=lambda f: f.__name__)
def test_margins_are_those_of_the_closed_form(make):
    diagram, L, (low, middle, high) = make()
    loop = diagram.linearize().loop("u")
    s = 1j * np.array([low, middle, high])
    assert np.max(np.abs(loop(s) / L(s) - 1)) < 1e-12
    made = margins(loop)
    assert made.stable
    w = np.geomspace(low / 30, 30 * high, 40_001)
    crossovers = roots(lambda w: np.log(np.abs(L(1j * w))), w)
    assert [c.frequency.value for c in made.gain_crossovers] == pytest.approx(crossovers, rel=1e-10)
    ahead = np.degrees(np.angle(-L(1j * crossovers)))
    assert made.phase_margin_deg.value == pytest.approx(np.min(np.abs(ahead)), abs=1e-8)
    lag = np.radians(ahead) % (2 * np.pi)
    assert made.delay_margin_s.value == pytest.approx(np.min(lag / crossovers), rel=1e-9)
    turns = roots(lambda w: L(1j * w).imag / np.abs(L(1j * w)), w)
    factors = np.array([-1 / L(1j * x).real for x in turns if L(1j * x).real < 0])
    assert made.gain_margin_high.value == pytest.approx(np.min(factors[factors > 1]), rel=1e-9)
    if np.any(factors < 1) or make is unstable_plant:
        at_rest = [1 / 1.5] if make is unstable_plant else []  # L(0) = −1.5
        assert made.gain_margin_low.value == pytest.approx(max([*factors[factors < 1], *at_rest]), rel=1e-9)
    k = int(np.argmax(1 / np.abs(1 + L(1j * w))))
    best = minimize_scalar(
        lambda x: np.abs(1 + L(1j * x)), bounds=(w[k - 1], w[k + 1]), method="bounded", options={"xatol": 1e-13}
    )
    assert made.ms.value == pytest.approx(1 / best.fun, rel=1e-9)


@pytest.mark.parametrize("k", [0.5, 1.5, 1.5707, 1.5709, 3.0, 9.0, 40.0])
def test_roots_of_a_delayed_integrator_are_those_of_lamberts_w(k):
    """The roots of s + k e^(−s): those of W of −k."""
    system = DelayMatrices(*(np.array([[v]]) for v in (0.0, -k, 1.0, 0.0)), np.array([1.0]))
    wanted = np.array([lambertw(-k, branch) for branch in range(-30, 31)])
    assert system.count_unstable() == np.sum(wanted.real > 0)
    near = sorted(wanted, key=lambda p: -p.real)[: max(4, int(np.sum(wanted.real > 0)))]
    assert all(np.min(np.abs(system.roots - root)) < 1e-9 for root in near)


@pytest.mark.parametrize(("k", "count"), [(0.9, 1), (1.1, 0), (3.2, 0), (6.0, 2), (40.0, 4)])
@pytest.mark.drawn(1)
def test_the_count_includes_the_poles_of_the_loop_itself(k, count):
    """(s − 1) + k e^(−0.3 s), whose roots mpmath finds: the plant alone is unstable."""
    plant = rational([1.0], [1.0, -1.0], "plant")
    u = Gain(gain=k, name="k")(error(plant.y)).named("u")
    model = Diagram("d", plant(delay(0.3)(u))).linearize()
    starts = [complex(x, y) for x in (0.5, 1.5, 3.0) for y in np.arange(0.0, 60.0, 2.0)]
    found = set()
    for start in starts:
        try:
            root = complex(mpmath.findroot(lambda s: s - 1 + k * mpmath.exp(-0.3 * s), start))
        except ValueError:
            continue
        found |= {np.round(root, 6), np.round(np.conj(root), 6)} if root.real > 0 else set()
    assert len({complex(round(p.real, 6), round(p.imag, 6) + 0.0) for p in found}) == count
    assert model.characteristic.count_unstable() == count
    assert margins(model.loop("u")).stable == (count == 0)
    assert np.sum(model.poles.real > 0) == count


@pytest.mark.parametrize(("gain", "stable"), [(0.95, True), (1.05, False), (-0.95, True), (-1.05, False)])
def test_a_way_without_a_state_around_a_delay_needs_a_gain_below_one(gain, stable):
    """ẏ + ... with y(t − τ) fed back at once: a chain of poles at ln|gain|/τ."""
    late, lag = delay(0.5), rational([1.0], [1.0, 1.0], "lag")
    total = Sum(signs="++", name="total")
    y = total(Gain(gain=gain, name="g")(late(total.y)), lag(Constant(value=1.0, name="r") - total.y))
    assert (Diagram("d", y).linearize().characteristic.count_unstable() == 0) == stable


def test_two_ways_without_a_state_are_stable_for_all_delays_only_if_their_gains_sum_up_to_less_than_one():
    first, second = delay(1.0, "first"), delay(0.37, "second")
    for gains, stable in (((0.5, 0.45), True), ((0.5, 0.55), False), ((0.5, -0.55), False)):
        total = Sum(signs="+++", name="total")
        a, b = (Gain(gain=g, name=n)(d(total.y)) for g, n, d in zip(gains, "ab", (first, second), strict=True))
        diagram = Diagram("d", total(a, b, rational([1.0], [1.0, 1.0], "lag")(-0.1 * total.y)))
        assert (diagram.linearize().characteristic.count_unstable() == 0) == stable


@pytest.mark.slow
def test_python_control_draws_it_exactly_and_gets_no_wrong_matrices():
    diagram, L, _ = one_lag()
    loop = diagram.linearize().loop("u")
    w = np.geomspace(0.01, 30.0, 50)
    assert np.max(np.abs(np.ravel(control.frequency_response(loop, w).complex) / L(1j * w) - 1)) < 1e-12
    control.bode_plot(loop)
    assert control.nyquist_response(loop, omega=np.geomspace(1e-4, 1e3, 5000), warn_encirclements=False).count == 0
    for use in (control.ss, control.step_response, lambda system: system.A, lambda system: system.D):
        with pytest.raises(OptionError, match=r"a system with delays, which has no .*pade"):
            use(loop)
    S, T = diagram.linearize().sensitivity("u"), diagram.linearize().complementary("u")
    assert np.max(np.abs(S(1j * w) * (1 + L(1j * w)) - 1)) < 1e-12
    assert np.max(np.abs(T(1j * w) - L(1j * w) / (1 + L(1j * w)))) < 1e-12
    assert np.max(np.abs(control.feedback(loop, 1)(1j * w) - T(1j * w))) < 1e-12


def test_systems_with_delays_are_added_multiplied_and_closed():
    G = control.ss(control.tf([2.0], [5.0, 1.0]))
    late = DelayedSystem(control.ss([], [], [], [[0.0, 1.0], [1.0, 0.0]], 0), [0.7])
    s = 1j * np.array([0.1, 1.0, 4.0])
    e, g = np.exp(-0.7 * s), 2.0 / (5 * s + 1)
    for made, wanted in (
        (late * G, e * g),
        (G * late, e * g),
        (late + G, e + g),
        (G - late, g - e),
        (1 - 0.5 * late, 1 - 0.5 * e),
        ((late * G).feedback(1), e * g / (1 + e * g)),
        ((late * G).feedback(late), e * g / (1 + e * g * e)),
        (-late / 2, -0.5 * e),
    ):
        assert np.max(np.abs(made(s) - wanted)) < 1e-13
    rough = [np.max(np.abs((late * G).pade(order)(s) - e * g)) for order in (1, 2, 4, 6)]
    assert all(b < 0.2 * a for a, b in itertools.pairwise(rough))


def test_a_step_response_is_that_of_the_method_of_steps():
    """ẏ = u − k y(t − τ): Σ (−k)ⁿ (t − nτ)₊ⁿ⁺¹/(n + 1)!."""
    k, tau, t = 3.0, 0.37, np.linspace(0.0, 4.0, 301)
    system = DelayedSystem(control.ss([[0.0]], [[1.0, -k]], [[1.0], [1.0]], np.zeros((2, 2)), 0), [tau])
    wanted = sum(
        (-k) ** n * np.clip(t - n * tau, 0, None) ** (n + 1) / float(mpmath.factorial(n + 1)) for n in range(60)
    )
    assert np.max(np.abs(system.step_response(t)[:, 0] - wanted)) < 1e-10


def test_disk_margin_and_encirclements_take_loops_with_delays():
    diagram, L, _ = one_lag()
    loop = diagram.linearize().loop("u")
    found, w = disk_margin(loop), np.geomspace(0.05, 5.0, 20_001)
    k = int(np.argmax(np.abs((1 - L(1j * w)) / (1 + L(1j * w)))))
    best = minimize_scalar(
        lambda x: -0.5 * np.abs((1 - L(1j * x)) / (1 + L(1j * x))),
        bounds=(w[k - 1], w[k + 1]),
        method="bounded",
        options={"xatol": 1e-13},
    )
    assert found.alpha.value == pytest.approx(-1 / best.fun, rel=1e-9)
    assert abs(1 + found.destabilizing[0] * L(1j * found.frequency.value)) < 1e-9
    assert (nyquist_count(loop).encirclements, nyquist_count(loop).closed_loop) == (0, 0)
    plant, _, _ = unstable_plant()
    assert nyquist_count(plant.linearize().loop("u")).encirclements == -1


@pytest.mark.slow
def test_sensitivities_of_a_loop_with_dead_time_are_those_of_its_closed_form():
    """K e^(−τ s)/s: the phase margin in degrees is 90 − K τ 180/π, the gain margin π/(2 K τ)."""
    diagram, _, _ = integrating()
    found = diagram.sensitivities("u", ["k.gain", "late.delay"])
    slopes = {(s.parameter, s.quantity): s.slope.value for s in found.rows}
    assert slopes["k.gain", "phase_margin_deg"] == pytest.approx(-0.8 * 180 / np.pi, rel=1e-8)
    assert slopes["k.gain", "gain_margin_high"] == pytest.approx(-np.pi / (2 * 0.7**2 * 0.8), rel=1e-8)
    assert slopes["late.delay", "phase_margin_deg"] == pytest.approx(-0.7 * 180 / np.pi, rel=1e-4)
    assert slopes["late.delay", "gain_margin_high"] == pytest.approx(-np.pi / (2 * 0.7 * 0.8**2), rel=1e-4)


@pytest.mark.slow
def test_the_worst_case_of_a_dead_time_is_the_longest_and_the_run_says_so():
    diagram, _, _ = integrating()
    worst = diagram.worst_case({"late.delay": (0.6, 1.0)}, "u", quantity="phase_margin_deg", count=2)
    assert worst.parameters == {"late.delay": 1.0}
    assert worst.worst.value == pytest.approx(90 - 0.7 * 180 / np.pi, abs=1e-8)
    assert "confirmed" in str(worst.confirm())


def test_an_angle_behind_a_loop_with_dead_time_is_free_and_its_ramp_is_not():
    lag, late, pipe = rational([2.0], [1.0, 1.0], "lag"), delay(0.25), delay(0.4, "pipe")
    angle, ramp = Integrator(name="angle"), Integrator(name="ramp")
    y = lag(late(pi(lag.y, 0.5, 0.4)))
    model = Diagram("d", angle(y)).linearize()
    free = model.free_motions()
    assert [str(motion) for motion in free.motions] == ["angle.y drifts: nothing feeds it back"]
    assert model.characteristic.count_unstable() == 1
    assert model.characteristic_without(free).count_unstable() == 0
    alone = Diagram("d", y).linearize()
    assert model.poles_without(free)[:3] == pytest.approx(alone.poles[:3], abs=1e-9)
    ramped = Diagram("d", ramp(pipe(angle(y)))).linearize()
    assert ramped.characteristic_without(ramped.free_motions()).count_unstable() > 0


def test_a_model_with_pades_approximation_says_its_order_and_how_far_it_is_right():
    """Padé's approximation of order 2 of e^(−s): (s² − 6 s + 12)/(s² + 6 s + 12); the numbers carry the finding."""
    diagram, L, _ = one_lag()
    model = diagram.linearize(delays="pade", order=2)
    loop, s = model.loop("u"), 1j * np.array([0.1, 1.0, 3.0])
    pade = (s * s - 6 * s + 12) / (s * s + 6 * s + 12)
    assert np.max(np.abs(loop(s) / (L(s) * np.exp(s) * pade) - 1)) < 1e-12
    (finding,) = model.findings
    assert (finding.block, finding.order, finding.delay) == ("late", 2, 1.0)
    assert "Padé's approximation of order 2, right to 1 % up to" in str(finding)

    def error(w):
        return abs((-w * w - 6j * w + 12) / (-w * w + 6j * w + 12) - np.exp(-1j * w)) - 0.01

    assert finding.limit == pytest.approx(brentq(error, 0.5, 3.0), rel=3e-3)
    assert margins(loop).phase_margin_deg.findings == (finding,)
    assert model.A.shape == (4, 4)
    assert model.delays is None


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


def neutral(k, a, b, tau):
    """k e^(−sτ)(s + a)/(s + b): up to infinite frequency |L| comes to k, and the curve turns around 0."""
    plant, late = rational([1.0, a], [1.0, b], "plant"), delay(tau)
    u = Gain(gain=k, name="k")(error(late.y)).named("u")
    return Diagram("d", late(plant(u)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("k", "a", "b", "tau"), [(0.4, 2.0, 1.0, 0.5), slow(0.9, 2.0, 1.0, 0.5), slow(0.3, 3.0, 1.0, 2.0)]
)
def test_a_neutral_loop_that_falls_to_its_gain_at_infinity_is_decided_at_its_first_crossings(k, a, b, tau):
    """|L| falls with ω, so the first crossing of the negative axis limits the gain."""
    L = lambda s: k * np.exp(-s * tau) * (s + a) / (s + b)  # noqa: E731
    phase = lambda w: -w * tau + np.arctan(w / a) - np.arctan(w / b) + np.pi  # noqa: E731
    at = brentq(phase, 1e-3, np.pi / tau, xtol=1e-15)
    omega = np.linspace(1e-4, 3 * np.pi / tau, 20001)
    first = omega[np.argmin(np.abs(1 + L(1j * omega)))]
    ms = -minimize_scalar(
        lambda w: -1 / abs(1 + L(1j * w)),
        bounds=(first - 0.01, first + 0.01),
        method="bounded",
        options={"xatol": 1e-12},
    ).fun
    found = margins(neutral(k, a, b, tau).linearize().loop("u"))
    assert found.stable
    assert abs(found.gain_margin_high.value * abs(L(1j * at)) - 1) < 1e-9
    assert abs(found.ms.value / ms - 1) < 1e-9
    assert np.isinf(found.phase_margin_deg.value) == (k * a / b < 1)
    places = [float(c.frequency.value) for c in found.phase_crossovers[:-1]]
    for n, omega in enumerate(places):  # each turn has one, and none is left out
        crossing = brentq(lambda w, n=n: phase(w) + 2 * np.pi * n, 1e-3, (2 * n + 3) * np.pi / tau, xtol=1e-14)
        assert abs(omega / crossing - 1) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("k", [0.5, 0.9])
def test_a_neutral_loop_that_rises_to_its_gain_at_infinity_has_the_margins_of_that_gain(k):
    """With a < b |L| is below k at every frequency, and comes as near to −k as one likes."""
    found = margins(neutral(k, 1.0, 2.0, 0.5).linearize().loop("u"))
    for number, value in (
        (found.gain_margin_high, 1 / k),
        (found.ms, 1 / (1 - k)),
        (found.disk_margin, 2 * (1 - k) / (1 + k)),
    ):
        assert abs(number.value - value) <= max(number.tolerance, 1e-12 * value)
        assert number.tolerance < 1e-3 * value


def test_a_neutral_loop_with_a_gain_of_one_or_more_has_a_chain_of_unstable_poles_and_names_its_blocks():
    k, a, b, tau = 1.2, 2.0, 1.0, 0.5
    model = neutral(k, a, b, tau).linearize()
    assert model.characteristic.count_unstable() == np.inf
    assert abs(model.characteristic.chains - np.log(k) / tau) < 1e-12
    assert model.neutral_blocks == ("e", "k", "late", "plant")
    beyond = [p for p in model.poles if p.real > 0]
    assert len(beyond) >= 4
    for pole in beyond:
        s = mpmath.mpc(pole)
        f = lambda s: (s + b) + k * mpmath.exp(-s * tau) * (s + a)  # noqa: E731
        assert abs(f(s) / mpmath.diff(f, s)) < 1e-9 * abs(pole)
    found = margins(model.loop("u"))
    assert not found.stable
    assert "infinitely many of its poles" in found.ms.confirmed_by
    assert found.encirclements == np.inf
    assert neutral(0.9, a, b, tau).linearize().neutral_blocks == ()


def test_chains_of_a_neutral_system_with_two_delays_are_the_largest_for_all_their_ratios():
    """1 − g₁ e^(−sτ₁) − g₂ e^(−sτ₂) = 0 has its largest Re s where both are positive."""
    g, tau = (0.5, 0.6), (1.0, 0.3)
    H = np.array([[g[0], g[1]], [g[0], g[1]]])
    system = DelayMatrices(np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((2, 0)), H, np.array(tau))
    c = brentq(lambda c: g[0] * np.exp(-c * tau[0]) + g[1] * np.exp(-c * tau[1]) - 1, -5, 5, xtol=1e-14)
    assert abs(system.chains - c) < 1e-9


def test_roots_are_counted_where_ways_without_a_state_cancel_each_other_for_every_delay():
    """H is 0.85 times a rotation: |H| sums up to 1.2, but |(I − H E)⁻¹| ≤ 6.6. By the small gain it is stable up to 1."""
    H, G, C = np.array([[0.6, 0.6], [-0.6, 0.6]]), np.array([[0.1, 0.02]]), np.array([[1.0], [0.2]])
    system = DelayMatrices(np.array([[-1.0]]), G, C, H, np.array([0.4, 0.7]))
    assert abs(system.gain_at_infinity - np.sqrt(0.72)) < 1e-14  # both singular values are the same
    assert np.linalg.norm(G) * np.linalg.norm(C) / (1 - np.sqrt(0.72)) < 0.7
    assert system.count_unstable() == 0
    f = 1 + G @ np.linalg.solve(np.eye(2) - H, C)  # with −A less than what comes back at s = 0 a root is unstable
    assert DelayMatrices(np.array([[1.0 - f[0, 0] + 0.01]]), G, C, H, system.tau).count_unstable() == 1


@pytest.mark.slow
def test_a_smith_predictor_with_feedthrough_to_two_delays_is_not_neutral_and_keeps_its_gain_margin():
    """C e^(−17 s) P/(1 + C P (1 − e^(−15 s))): the controller feeds two delays at once, but no way back is without a state."""
    plant, late = rational([1.0], [20.0, 1.0], "plant"), delay(17.0)
    model, model_late = rational([1.0], [20.0, 1.0], "model"), delay(15.0, "model_late")
    u = rational([2.0, 0.1], [1.0, 0.0], "pi")(error(plant.y - model_late.y + model.y)).named("u")
    diagram = Diagram("d", plant(late(u)), model_late(model(u)))
    C, P = lambda s: 2 + 0.1 / s, lambda s: 1 / (20 * s + 1)
    L = lambda s: C(s) * P(s) * np.exp(-17 * s) / (1 + C(s) * P(s) * (1 - np.exp(-15 * s)))  # noqa: E731
    at = brentq(lambda w: L(1j * w).imag, 0.1, 0.15, xtol=1e-15)
    found = margins(diagram.linearize().loop("u", to=["late.u"]))
    assert L(1j * at).real < 0
    assert abs(found.gain_margin_high.value * abs(L(1j * at)) - 1) < 1e-9


@pytest.mark.parametrize("k", [99.0, 500.0, pytest.param(2000.0, marks=pytest.mark.slow)])
def test_a_delay_far_from_stable_has_all_its_roots(k):
    """s + k e^(−s): roots are Lambert's W_n(−k), a pair crosses the axis at each k = π/2 + 2π n."""
    made = DelayMatrices(np.zeros((1, 1)), np.array([[-k]]), np.ones((1, 1)), np.zeros((1, 1)), np.ones(1))
    count = 2 * (int((k - np.pi / 2) // (2 * np.pi)) + 1)
    assert made.count_unstable() == count
    poles = np.array(made.poles())
    exact = np.array([lambertw(-k, n) for n in range(-count // 2, count // 2)])
    exact = exact[np.lexsort((exact.imag, -exact.real))]
    assert np.sum(poles.real > 0.0) == count
    for pole in exact:
        assert np.min(np.abs(poles - pole)) < 1e-9 * abs(pole)


@pytest.mark.parametrize(("b", "tau"), [(0.9, 2000.0), (-0.9, 2000.0), (1.01, 2000.0), (-1.01, 2000.0)])
def test_a_delay_that_is_long_beside_a_lag_has_all_its_roots(b, tau):
    """s + 1 − b e^(−s τ): s τ = W_n(b τ e^τ) − τ, by w + ln w = ln b τ + τ + 2π i n."""
    made = DelayMatrices(-np.ones((1, 1)), np.array([[b]]), np.ones((1, 1)), np.zeros((1, 1)), np.array([tau]))
    exact = []
    for n in range(-60, 61):
        target = np.log(complex(b * tau)) + tau + 2j * np.pi * n
        w = target - np.log(target)
        for _ in range(50):
            w -= (w + np.log(w) - target) / (1.0 + 1.0 / w)
        exact.append((w - tau) / tau)
    exact = np.array(exact)
    beyond = exact[exact.real > 0.0]
    assert made.count_unstable() == len(beyond)
    poles = np.array(made.poles())
    for pole in beyond:
        assert np.min(np.abs(poles - pole)) < 1e-9 * (1.0 + abs(pole))


@pytest.mark.parametrize("sensor", [1e-2, 1e-6])
@pytest.mark.drawn(1)
def test_a_dead_time_that_is_long_beside_a_sensor_has_its_margin(sensor):
    """An oven by the SIMC rule: 90° − 0.02 · 25 rad, less the sensor's phase; nothing overflows on the way."""
    oven, late, quick = rational([2.5], [180.0, 1.0], "oven"), delay(25.0), rational([1.0], [sensor, 1.0], "sensor")
    loop = Diagram("oven", quick(late(oven(pi(quick.y, 1.44, 1.44 / 180.0))))).linearize().loop("u")
    found = margins(loop)
    assert found.stable
    at = brentq(lambda w: 0.02 / w / np.hypot(1.0, sensor * w) - 1.0, 1e-3, 1.0, xtol=1e-15)
    exact = 90.0 - np.degrees(25.0 * at + np.arctan(sensor * at))
    assert found.phase_margin_deg.value == pytest.approx(exact, abs=1e-7)


@pytest.mark.slow
def test_pade_of_a_sampled_diagram_is_refused():
    plant, late = rational([2.0], [5.0, 1.0], "lag"), delay(1.0)

    @subsystem(sample_time=0.5)
    def control(y):
        return Gain(gain=0.4, name="k")(0.0 - y).named("u")

    diagram = Diagram("sampled", late(plant(control(late.y))))
    with pytest.raises(OptionError, match=r"delays: found 'pade' for a sampled model, which is rational as it is"):
        diagram.linearize(delays="pade")
    assert diagram.continuous().linearize(delays="pade").pade == 5


@pytest.mark.parametrize("ki", [0.05, 0.1, 0.15, 0.2, 0.3])
@pytest.mark.slow
def test_an_integrator_behind_a_predictor_is_a_root_at_zero_whatever_the_gain(ki):
    """A Smith predictor whose PI cancels the lag: L = a e^(-8 s) / (s + a (1 - e^(-8 s))), a = 2 ki, with a pole at 0.

    |L| = 1 and the phase there from the closed form; a root at 0 came out as 1e-17 to either side, and was missed.
    """
    pipe, model_pipe = TransportDelay(delay=8.0, name="pipe"), TransportDelay(delay=8.0, name="model_pipe")
    model = TransferFunction(numerator=2.0, denominator=[10.0, 1.0], name="model")
    lag = TransferFunction(numerator=2.0, denominator=[10.0, 1.0], name="lag")
    u = PID(kp=10.0 * ki, ki=ki)(1.0, model.y + (pipe.y - model_pipe.y)).named("u")
    loop = Diagram("smith", pipe(lag(u)).named("y"), model_pipe(model(u))).linearize().loop("u", to="lag.u")
    a, found = 2.0 * ki, margins(loop)

    def at(w):
        return a * np.exp(-8j * w) / (1j * w + a * (1.0 - np.exp(-8j * w)))

    w = np.linspace(1e-3, 40.0 * a, 400001)
    turns = np.flatnonzero(np.diff(np.sign(np.abs(at(w)) - 1.0)))
    crossings = [brentq(lambda x: abs(at(x)) - 1.0, w[i], w[i + 1], xtol=1e-15) for i in turns]
    assert found.stable
    least = min(np.degrees(np.abs(np.angle(-at(x)))) for x in crossings)
    assert found.phase_margin_deg.value == pytest.approx(least, abs=1e-7)


def predictor_of_a_lag(known):
    """A PI controller that cancels the lag of its Smith predictor, whose model of the dead time of 8 s is ``known``."""
    pipe, model = delay(8.0, "pipe"), rational([2.0], [10.0, 1.0], "model")
    u = pi(model.y + (pipe.y - delay(known, "model_pipe")(model.y)), 1.5, 0.15)
    lag = rational([2.0], [10.0, 1.0], "lag")
    return Diagram("predictor", pipe(lag(u)), model(u)).linearize().loop("u", to="model.u")


@pytest.mark.parametrize(("known", "crossings"), [(8.0, 1), (8.5, None)])
def test_only_crossings_that_may_decide_are_refined_of_a_response_that_passes_zero_at_each_turn(
    known, crossings, monkeypatch
):
    """Ahead of its model alone L = 0.3 (1 − e^(−s known))/(s + 0.3 e^(−8 s)), which is 0 at each 2πk/known."""
    floor, calls = 3e-3, list[int]()
    L = lambda w: 0.3 * (1 - np.exp(-1j * w * known)) / (1j * w + 0.3 * np.exp(-8j * w))  # noqa: E731
    w = np.linspace(1e-3, 0.6 / floor, 400_001)
    at = L(w)
    k = np.flatnonzero((at.imag[1:] * at.imag[:-1] < 0) & (np.abs(at.real[1:]) >= 0.5 * floor) & (at.real[1:] < 0))
    roots = [brentq(lambda w: L(w).imag, w[i], w[i + 1], xtol=1e-15) for i in k]
    expected = [root for root in roots if L(root).real <= -floor]
    r = realize(predictor_of_a_lag(known))
    response = DelayedRealization.response
    monkeypatch.setattr(DelayedRealization, "response", lambda r, w: calls.append(np.size(w)) or response(r, w))
    found = [c for c in LoopScan(r, floor=floor).phase_crossovers if abs(c.L) >= floor]
    np.testing.assert_allclose([c.omega for c in found], expected, rtol=1e-9)
    np.testing.assert_allclose([c.L.real for c in found], [L(root).real for root in expected], rtol=1e-8)
    assert crossings is None or len(found) == crossings
    assert len(calls) < 100 + 15 * len(found)  # one root after the other took 20 more for each turn


@pytest.mark.slow
def test_of_many_crossings_those_that_can_not_decide_are_left_out(monkeypatch):
    """A model of the dead time that is 0.5 % too long: L = 0.3 (1 + e^(−8 s) − e^(−8.04 s))/s crosses at each turn."""
    calls, response = list[int](), DelayedRealization.response
    monkeypatch.setattr(DelayedRealization, "response", lambda r, w: calls.append(np.size(w)) or response(r, w))
    pipe, model = delay(8.0, "pipe"), rational([2.0], [10.0, 1.0], "model")
    u = pi(model.y + (pipe.y - delay(8.04, "model_pipe")(model.y)), 1.5, 0.15)
    loop = Diagram("late", pipe(rational([2.0], [10.0, 1.0], "lag")(u)), model(u)).linearize().loop("u")
    L = lambda w: 0.3 * (1 + np.exp(-8j * w) - np.exp(-8.04j * w)) / (1j * w)  # noqa: E731
    w = np.linspace(1e-3, 300.0, 600_001)
    at = L(w)
    k = np.flatnonzero((at.imag[1:] * at.imag[:-1] < 0) & (at.real[1:] < 0))
    largest = max(-L(brentq(lambda w: L(w).imag, w[i], w[i + 1], xtol=1e-15)).real for i in k)
    assert scan_margins(loop)["gain_margin_high"] == pytest.approx(1 / largest, rel=1e-9)
    assert len(k) > 200
    assert len(calls) < 2000


@pytest.mark.slow
def test_a_predictor_whose_model_is_exact_has_margins_ahead_of_its_model_in_no_time(monkeypatch):
    """The floor of its scan falls to 1e-9, where tens of thousands of turns were refined (400 s)."""
    calls, response = list[int](), DelayedRealization.response
    monkeypatch.setattr(DelayedRealization, "response", lambda r, w: calls.append(np.size(w)) or response(r, w))
    found = margins(predictor_of_a_lag(8.0))
    L = lambda w: 0.3 * (1 - np.exp(-8j * w)) / (1j * w + 0.3 * np.exp(-8j * w))  # noqa: E731
    low = brentq(lambda w: L(w).imag, 0.22, 0.24, xtol=1e-15)
    w = np.linspace(1e-3, 1.0, 100_001)  # |L| < 1 beyond, as 0.6 < |s + 0.3 e^(−8 s)| there
    turns = np.flatnonzero(np.diff(np.sign(np.abs(L(w)) - 1)))
    ones = [brentq(lambda x: abs(L(x)) - 1, w[i], w[i + 1], xtol=1e-15) for i in turns]
    assert found.gain_margin_low.value == pytest.approx(-1 / L(low).real, rel=1e-9)
    assert np.isinf(found.gain_margin_high.value)
    assert found.phase_margin_deg.value == pytest.approx(
        min(np.degrees(np.abs(np.angle(-L(x)))) for x in ones), abs=1e-8
    )
    assert len(calls) < 5000
    assert sum(calls) < 2_000_000


@pytest.mark.drawn(2)
@pytest.mark.parametrize("gain", [0.5, 0.8, 2.0])
def test_a_gain_around_a_dead_time_has_the_margins_of_a_circle(gain):
    """L = k e^(−s): |L| is k, and −1 is passed at odd multiples of π with the factor 1/k; above 1 nothing is stable."""
    late, reference = TransportDelay(delay=1.0, name="late"), Constant(value=1.0)
    diagram = Diagram("d", late((gain * (reference - late.y)).named("u")))
    found = margins(diagram.linearize().loop("u"))
    assert found.stable is (gain < 1.0)
    if gain < 1.0:
        assert float(found.gain_margin_high) == pytest.approx(1.0 / gain, rel=1e-9)
        assert float(found.modulus_margin) == pytest.approx(1.0 - gain, rel=1e-6)
        assert float(found.ms) == pytest.approx(1.0 / (1.0 - gain), rel=1e-6)
    else:
        assert np.isnan(float(found.gain_margin_high))


def test_delays_are_split_from_their_rest_and_fed_back():
    """u = −k y of ẋ = u, y = x(t − 1): s = W(−k) is a pole; without the delay at rest, y = x."""
    k = 0.7
    names, tau = ("late.y",), np.array([1.0])
    rest = np.zeros((1, 1)), np.array([[1.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[0.0, 1.0], [0.0, 0.0]])
    matrices, late = LinearDelays.split(rest, tau, names)
    assert [M.tolist() for M in matrices] == [[[0.0]], [[1.0]], [[0.0]], [[0.0]]]
    assert [M.tolist() for M in (late.G, late.Z, late.H, late.E, late.F)] == [[[0]], [[1]], [[0]], [[1]], [[0]]]
    assert all(np.array_equal(a, b) for a, b in zip(late.join(matrices), rest, strict=True))
    (A, *_), closed = late.feed_back(matrices, np.array([[-k]]), np.eye(1), np.eye(1))
    root = complex(lambertw(-k))
    assert abs(np.linalg.det(closed.matrix_at(A, root))) < 1e-14
    assert abs(np.linalg.det(closed.matrix_at(A, root + 0.1))) > 0.01
    assert (A + closed.G @ closed.settle(closed.Z)).tolist() == [[pytest.approx(-k, rel=1e-14)]]
