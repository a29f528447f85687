"""Disk margins of one and of several channels, and sensitivities: closed forms, SciPy, and perturbations that destabilize."""

import control
import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.optimize import brentq, minimize, minimize_scalar

from loopwright.blocks import ParameterError
from loopwright.diagrams import ConfirmationError
from loopwright.diagrams.frequency import disk_margins as disk
from loopwright.frequency import (
    complementary,
    delayed_hold,
    delayed_hold_margin,
    disk_margin,
    gang_of_four,
    loop_at,
    margins,
    mimo_disk_margin,
    sensitivity,
)
from support.loops import sampled_triple, triple
from support.random_cases import random_cases

SATELLITE = control.ss([[0, 10], [-10, 0]], np.eye(2), [[1, 10], [-10, 1]], 0)  # Doyle's spinning body, unit feedback


@pytest.mark.parametrize(("skew", "alpha"), [(0.0, 1.2), (1.0, 1.0), (-1.0, 7 / 9)])
def test_the_triple_pole_has_its_closed_form_for_each_skew(skew, alpha):
    found = disk_margin(triple(20.0), skew=skew)
    assert found.alpha.value == pytest.approx(alpha, rel=1e-9)
    assert found.destabilizing_alpha == pytest.approx(alpha, rel=1e-9)


def test_gains_and_phase_of_the_symmetric_disk_are_those_of_its_definition():
    found = disk_margin(triple(20.0))
    assert (found.gain_low, found.gain_high) == pytest.approx((0.8 / 3.2, 3.2 / 0.8), rel=1e-9)
    assert found.phase_deg == pytest.approx(2 * np.degrees(np.arctan(1.2 / 2)), rel=1e-9)


def crossings(value, angles):
    """Angles at which a real function of the angle changes its sign, each to the last bits."""
    values = np.array([value(a) for a in angles])
    return [
        brentq(value, a, b, xtol=1e-14, rtol=1e-14)
        for a, b, y, z in zip(angles, angles[1:], values, values[1:], strict=False)
        if y * z < 0 and abs(y) < 1e3 and abs(z) < 1e3  # a change from -inf to inf is none
    ]


@pytest.mark.parametrize("skew", [-1.0, -0.5, 0.0, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("alpha", [0.3, 0.9, 1.05, 1.2, 1.9])
def test_gain_and_phase_of_a_disk_are_the_first_points_of_its_boundary(alpha, skew):
    def boundary(angle):
        delta = alpha * np.exp(1j * angle)
        return (1 + (1 - skew) / 2 * delta) / (1 - (1 + skew) / 2 * delta)

    low, high, phase = disk.disk_gains(alpha, skew)
    around = np.linspace(
        -0.0137, 2 * np.pi - 0.0137, 721
    )  # 0 and pi, where the boundary may be real, between two of them
    real = [boundary(a).real for a in crossings(lambda a: boundary(a).imag, around)]
    above, below = [x for x in real if x > 1], [x for x in real if 0 < x < 1]
    assert high == pytest.approx(min(above, default=np.inf), rel=1e-6)
    assert low == pytest.approx(max(below, default=0.0), rel=1e-6)
    turns = [abs(np.angle(boundary(a), deg=True)) for a in crossings(lambda a: np.log(abs(boundary(a))), around)]
    assert phase == pytest.approx(min(turns, default=180.0), rel=1e-6)


@pytest.mark.parametrize("delay", [0, 1])
def test_the_smallest_perturbation_puts_a_pole_on_the_limit(delay):
    loop = sampled_triple(40.0) * (control.ss(0, 1, 1, 0, 1e-3) if delay else 1)
    found = disk_margin(sampled_triple(40.0), delay=delay)

    def radius(f):
        return np.abs(np.linalg.eigvals(loop.A - f * loop.B @ loop.C)).max()

    (f,) = found.destabilizing
    assert radius(f) == pytest.approx(1.0, abs=1e-9)
    direction = np.angle((f - 1) / (f + 1))  # of the perturbation in f = (1 + d/2)/(1 - d/2)
    for size, stable in ((0.999, True), (1.001, False)):
        delta = size * found.alpha.value * np.exp(1j * np.append(np.linspace(0, 2 * np.pi, 90), direction))
        assert (max(radius(disk.factor(d)) for d in delta) < 1) == stable


def smallest_by_scipy(system, frequencies):
    """The disk margin of two channels: SciPy's scaling at each frequency, and SciPy's search for the frequency."""

    def mu(omega):
        M = np.linalg.inv(np.eye(2) + system(1j * omega)) - np.eye(2) / 2
        scaled = lambda x: np.linalg.norm(np.diag([np.exp(x), 1]) @ M @ np.diag([np.exp(-x), 1]), 2)  # noqa: E731
        return minimize_scalar(scaled, bounds=(-5, 5), method="bounded", options={"xatol": 1e-10}).fun

    found = minimize_scalar(lambda w: -mu(w), bounds=frequencies, method="bounded", options={"xatol": 1e-10})
    return -1 / found.fun


@pytest.mark.slow
def test_the_spinning_body_has_small_margins_although_each_channel_alone_has_large_ones():
    found = mimo_disk_margin(SATELLITE)
    # L(0) = -I + J/10 with J² = -I: S - 1/2 = -10 J - 1/2 has μ² = 100 + 1/4; the peak is beside it, at 0.05 rad/s
    assert found.alpha.value == pytest.approx(1 / np.sqrt(100.25), rel=3e-3)
    assert found.alpha.value == pytest.approx(smallest_by_scipy(SATELLITE, (1e-3, 1.0)), rel=1e-6)
    assert found.destabilizing_alpha == pytest.approx(found.alpha.value, rel=1e-6)
    closed = SATELLITE.A - SATELLITE.B @ np.diag(found.destabilizing) @ SATELLITE.C
    assert np.linalg.eigvals(closed).real.max() == pytest.approx(0.0, abs=1e-6)
    one = control.ss(SATELLITE.A - SATELLITE.B[:, 1:] @ SATELLITE.C[1:], SATELLITE.B[:, :1], SATELLITE.C[:1], 0)
    assert disk_margin(one).alpha.value == pytest.approx(2.0, rel=1e-6)  # L = 1/s: no limit in either direction
    both = mimo_disk_margin(loop_at(SATELLITE, control.ss([], [], [], np.eye(2)), "both"))
    assert both.alpha.value < found.alpha.value / 1.9  # at plant input and output at once
    assert both.destabilizing_alpha == pytest.approx(both.alpha.value, rel=1e-4)


def test_two_loops_that_do_not_meet_have_the_margin_of_the_worse_one():
    together = mimo_disk_margin(control.append(sampled_triple(20.0), sampled_triple(40.0)))
    worse = disk_margin(sampled_triple(40.0))
    assert together.alpha.value == pytest.approx(worse.alpha.value, rel=1e-9)


def test_the_margin_at_both_ends_of_one_channel_is_smaller_than_at_one():
    plant, controller = control.ss(control.tf([1.0], [1, 1, 0])), control.ss([], [], [], 2.0)
    one = mimo_disk_margin(loop_at(plant, controller, "input")).alpha.value
    both = mimo_disk_margin(loop_at(plant, controller, "both"))
    assert both.alpha.value < one
    assert both.destabilizing_alpha == pytest.approx(both.alpha.value, rel=1e-6)


complex_entries = st.tuples(st.floats(-3, 3), st.floats(-3, 3)).map(lambda v: complex(*v))


@pytest.mark.slow
@random_cases(10, 40, st.lists(complex_entries, min_size=4, max_size=4), reaching=0.5)
def test_the_closed_form_for_two_channels_is_what_scaling_by_scipy_finds(entries):
    M = np.array(entries).reshape(2, 2)

    def scaled(x):
        d = np.array([np.exp(x[0]), 1.0])
        return np.linalg.svd(d[:, None] * M / d, compute_uv=False)[0]

    found = min(
        minimize(scaled, [x0], method="Nelder-Mead", options={"xatol": 1e-12, "fatol": 1e-14, "maxiter": 4000}).fun
        for x0 in (-3, 0, 3)
    )
    assert disk.mu_bound(M) <= found * (1 + 1e-9) + 1e-12
    if min(abs(M[0, 1]), abs(M[1, 0])) <= 1e-3:  # the best scaling is at infinity
        return False
    assert disk.mu_bound(M) == pytest.approx(found, rel=1e-6)
    return True


@random_cases(10, 100, st.lists(complex_entries, min_size=4, max_size=4), reaching=0.5)
def test_the_bound_is_exact_for_two_channels(entries):
    M = np.array(entries).reshape(2, 2)
    bound = disk.mu_bound(M)
    if bound <= 1e-3:
        return False
    lower, delta = disk.mu_lower_bound(M)
    assert lower == pytest.approx(bound, rel=1e-5)
    assert abs(np.linalg.det(np.eye(2) - M @ np.diag(delta))) < 1e-6 * max(1, bound)
    return True


@pytest.mark.slow
@pytest.mark.drawn(2)
@pytest.mark.parametrize("seed", range(6))
def test_three_channels_lie_between_a_perturbation_and_any_scaling(seed):
    rng = np.random.default_rng(seed)
    M = rng.normal(size=(3, 3)) + 1j * rng.normal(size=(3, 3))
    bound, (lower, _) = disk.mu_bound(M), disk.mu_lower_bound(M)
    assert lower <= bound * (1 + 1e-9) + 1e-12
    assert bound <= np.linalg.norm(M, 2) * (1 + 1e-12) + 1e-12
    assert lower == pytest.approx(bound, rel=1e-5)  # exact up to three channels


@pytest.mark.drawn(1)
@pytest.mark.parametrize("n", [2, 3])
def test_nothing_destabilizes_where_nothing_is_fed_back(n):
    assert disk.mu_bound(np.zeros((n, n))) == disk.mu_lower_bound(np.zeros((n, n)))[0] == 0.0
    nilpotent = np.diag(np.ones(n - 1), 1)
    assert disk.mu_bound(nilpotent) < 1e-3  # the scaling that makes it vanish is infinite
    assert disk.mu_lower_bound(nilpotent)[0] < 1e-12


def test_an_unstable_loop_has_no_disk_margin():
    with pytest.raises(ParameterError, match="found 2 of 3 closed-loop poles that are not stable"):
        disk_margin(0.1 * triple(20.0))


def test_a_bound_that_is_wrong_is_an_error(monkeypatch):
    monkeypatch.setattr(disk, "mu_bound", lambda M, **_: 1.02 * np.linalg.norm(M, 2))
    with pytest.raises(ConfirmationError, match="smallest destabilizing perturbation"):
        mimo_disk_margin(SATELLITE)


# --- sensitivities and the delayed hold ---------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0, 0.1])
def test_the_gang_of_four_is_what_the_matrices_say(dt):
    rng = np.random.default_rng(1)
    P = control.ss(
        -np.eye(3) * 0.3, rng.normal(size=(3, 2)), rng.normal(size=(2, 3)), rng.normal(size=(2, 2)) * 0.2, dt
    )
    C = control.ss(
        -np.eye(2) * 0.1, rng.normal(size=(2, 2)), rng.normal(size=(2, 2)), rng.normal(size=(2, 2)) * 0.2, dt
    )
    four = gang_of_four(P, C)
    s = np.exp(0.7j) if dt else 0.7j
    p, c = P(s), C(s)
    S = np.linalg.inv(np.eye(2) + p @ c)
    for found, wanted in [(four.S, S), (four.PS, S @ p), (four.CS, c @ S), (four.T, S @ p @ c)]:
        assert found(s) == pytest.approx(wanted, rel=1e-12)
        assert found.dt == dt
        assert found.nstates == 5
    assert sensitivity(P * C)(s) + complementary(P * C)(s) == pytest.approx(np.eye(2), abs=1e-12)


def test_a_singular_loop_has_no_sensitivity():
    with pytest.raises(ParameterError, match="algebraic loop"):
        sensitivity(control.ss(-1, 1, 1, -1))


def controller(p, T):
    return control.ss(1.0, [[T, 0.0]], p**3, [[3 * p**2, 3 * p]], T)


AXIS = control.ss([[0, 1], [0, 0]], [[0], [1]], np.eye(2), 0)


@pytest.mark.parametrize("fraction", [0.0, 0.25, 1.0, 2.6])
def test_the_delayed_hold_is_what_simulation_between_the_ticks_gives(fraction):
    T, rng = 0.05, np.random.default_rng(0)
    plant = control.ss([[0, 1], [-9, -0.4]], [[0], [1]], np.eye(2), 0)
    u = rng.normal(size=30)
    model = delayed_hold(plant, T, fraction * T)
    x = np.zeros((model.nstates, 1))
    found = []
    for k in range(30):
        found.append((model.C @ x)[:, 0])
        x = model.A @ x + model.B * u[k]
    parts = 20  # fine holds of T/20, on which these delays are whole
    fine = control.sample_system(plant, T / parts, "zoh")
    held = np.concatenate([np.zeros(round(fraction * parts)), np.repeat(u, parts)])
    y, seen = np.zeros((2, 1)), []
    for k in range(30 * parts):
        if k % parts == 0:
            seen.append(y[:, 0])
        y = fine.A @ y + fine.B * held[k]
    assert np.array(found) == pytest.approx(np.array(seen), abs=1e-12)


@pytest.mark.slow
def test_whole_samples_of_delayed_hold_are_the_delay_of_the_loop():
    p, T = 20.0, 1e-3
    for n in (0, 1, 4):
        late = margins(controller(p, T) * delayed_hold(AXIS, T, n * T))
        assert late.phase_margin_deg.value == pytest.approx(
            margins(sampled_triple(p), delay=n).phase_margin_deg.value, abs=1e-8
        )


@pytest.mark.slow
def test_a_delay_between_the_ticks_is_borne_a_little_differently_than_the_response_says():
    p, T = 20.0, 1e-3
    exact = delayed_hold_margin(AXIS, controller(p, T))
    read = margins(sampled_triple(p, T)).delay_margin_s
    assert exact.value == pytest.approx(read.value, rel=1e-3)
    assert exact.value != pytest.approx(read.value, rel=1e-5)
    for factor, stable in ((0.999, True), (1.001, False)):
        loop = controller(p, T) * delayed_hold(AXIS, T, factor * exact.value)
        assert (np.abs(np.linalg.eigvals(loop.A - loop.B @ loop.C)).max() < 1) == stable


def test_a_plant_that_can_not_be_held_is_refused():
    with pytest.raises(ParameterError, match="without direct feedthrough"):
        delayed_hold(control.ss(-1, 1, 1, 1), 1e-3)
    with pytest.raises(ParameterError, match="expected T > 0"):
        delayed_hold(AXIS, 1e-3, -1.0)
    with pytest.raises(ParameterError, match="without any delay"):
        delayed_hold_margin(AXIS, -1.0 * controller(20.0, 1e-3))


def test_a_constant_loop_is_named_as_such():
    with pytest.raises(ParameterError, match="found a constant loop"):
        disk_margin(control.tf([1.0, 0.0, 1.0], [1.0, 0.0, 1.0]))
