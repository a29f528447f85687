"""Margins of loops: closed forms, both time domains, unstable and hidden modes, and that confirmations can fail."""

import json
import re
from fractions import Fraction

import control
import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import LoopwrightError, ParameterError
from loopwright.diagrams import ConfirmationError
from loopwright.diagrams.frequency import confirmations, loop_scan, scan_refine_confirm
from loopwright.diagrams.frequency.loop_scan import LoopScan
from loopwright.diagrams.frequency.realization import Realization
from loopwright.diagrams.frequency.sensitivity_peaks import confirm_peak
from loopwright.frequency import Number, margins, nyquist_count
from support.loops import open_loops, sampled_triple, stabilized_loops, triple
from support.random_cases import random_cases


def close(number, value, relative=1e-9):
    assert isinstance(number, Number)
    assert number.value == pytest.approx(value, rel=relative)
    assert abs(number.value - value) <= max(number.tolerance, 1e-15 * abs(value)), (number, value)
    assert number.confirmed_by


# --- closed forms -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("p", [1e-3, 1.0, 20.0, 40.0, 1e4])
def test_the_triple_pole_has_the_closed_form_margins_whatever_p_is(p):
    # with w = ω/p: L = (1 - 3w² + 3jw)/(-jw³); |L| = 1 where w⁶ - 9w⁴ - 3w² - 1 = 0; L is real where 3w² = 1
    found = margins(triple(p))
    w = np.sqrt(max(np.roots([1, -9, -3, -1]).real))
    phase = 180 + np.degrees(np.angle((1 - 3 * w**2 + 3j * w) / (-1j * w**3)))
    assert phase == pytest.approx(71.2498, abs=5e-5)
    close(found.phase_margin_deg, phase)
    close(found.gain_margin_low, 1 / 9)
    assert found.gain_margin_high.value == np.inf
    close(found.mt, 9 / 7)
    close(found.mt_frequency, p * 2 / np.sqrt(3), 1e-7)
    close(found.disk_margin, 1.2)
    close(found.ms, 1.0)
    close(found.modulus_margin, 1.0)
    close(found.delay_margin_s, np.radians(phase) / (w * p))
    # |T|² = 1/2 where (9w⁴ + 3w² + 1) 2 = (1 + w²)³
    b = np.sqrt(max(np.roots([1, 3 - 18, 3 - 6, 1 - 2]).real))
    close(found.bandwidth, b * p)
    ((gain,), (low,)) = found.gain_crossovers, found.phase_crossovers
    close(gain.frequency, w * p)
    close(low.frequency, p / np.sqrt(3))
    assert np.poly(found.closed_loop_poles) == pytest.approx([1, 3 * p, 3 * p**2, p**3], rel=1e-9)


@pytest.mark.parametrize(("p", "d0", "d1"), [(20.0, 69.5601, 66.0600), (40.0, 67.8870, 60.8862)])
def test_sampling_and_delay_cost_the_phase_margin_that_is_known(p, d0, d1):
    T = 1e-3
    found = margins(sampled_triple(p))
    assert found.phase_margin_deg.value == pytest.approx(d0, abs=5e-5)
    late = margins(sampled_triple(p), delay=1)
    assert late.phase_margin_deg.value == pytest.approx(d1, abs=5e-5)
    omega = late.gain_crossovers[0].frequency.value
    close(late.phase_margin_deg, found.phase_margin_deg.value - np.degrees(omega * T), 1e-9)
    close(late.delay_margin_samples, found.delay_margin_samples.value - 1, 1e-9)
    close(late.delay_margin_s, found.delay_margin_s.value - T, 1e-9)


def test_a_gain_margin_at_the_nyquist_frequency_is_found_and_confirmed():
    # at z = -1 the sampled double integrator is 0 for the position, the rate -T/2: L = -3pT/2, and -T/2·... of ∫e is 0
    p, T = 20.0, 1e-3
    found = margins(sampled_triple(p, T))
    close(found.gain_margin_high, 2 / (3 * p * T))
    assert found.phase_crossovers[-1].frequency.value == np.pi / T
    assert "unstable at" in found.gain_margin_high.confirmed_by


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_the_delay_of_samples_equals_delay_states_in_the_loop(delay):
    late = margins(sampled_triple(20.0), delay=delay)
    loop = sampled_triple(20.0)
    for _ in range(delay):
        loop = loop * control.ss(0, 1, 1, 0, 1e-3)
    for name, number in margins(loop).numbers().items():
        assert late.numbers()[name].value == pytest.approx(number.value, rel=1e-7), name


# --- simple loops with answers by hand ----------------------------------------------------------------------------------


def test_an_unstable_plant_has_a_reduction_margin_at_zero_frequency():
    found = margins(control.tf([2.0], [1.0, -1.0]))  # closed loop s + 1; the pole passes s = 0 at a factor of 1/2
    close(found.gain_margin_low, 0.5)
    assert found.phase_crossovers[0].frequency.value == 0.0
    assert found.gain_margin_high.value == np.inf
    close(found.phase_margin_deg, 60.0)  # |L| = 1 at √3, angle -120°
    close(found.delay_margin_s, np.pi / 3 / np.sqrt(3))
    assert found.encirclements == -1


def test_a_negative_direct_feedthrough_limits_the_gain_at_infinite_frequency():
    found = margins(control.ss(-1.0, 1.0, 0.75, -0.25))  # L = 0.75/(s + 1) - 0.25
    close(found.gain_margin_high, 4.0)
    assert found.phase_crossovers[-1].frequency.value == np.inf


def test_a_direct_feedthrough_above_one_bears_no_delay_at_all():
    found = margins(control.ss(-1.0, 1.0, 1.0, 2.0))
    assert found.delay_margin_s.value == 0.0
    assert found.stable


def test_a_loop_below_one_everywhere_has_no_phase_or_delay_limit():
    found = margins(control.tf([0.5], [1.0, 1.0]))
    assert found.phase_margin_deg.value == found.delay_margin_s.value == np.inf
    assert "stable at" in found.phase_margin_deg.confirmed_by


def test_an_integrator_with_a_delay_bears_what_the_closed_form_says():
    # sampled integrator k T/(z - 1): |L| = 1 at sin(ωT/2) = kT/2, phase -90° - ωT/2
    k, T = 5.0, 0.01
    omega = 2 / T * np.arcsin(k * T / 2)
    found = margins(control.ss(1.0, 1.0, k * T, 0.0, T))
    close(found.phase_margin_deg, 90 - np.degrees(omega * T / 2))
    close(found.delay_margin_samples, (np.pi / 2 - omega * T / 2) / (omega * T))
    close(found.gain_margin_high, 2 / (k * T))


def test_a_sampled_loop_above_one_at_the_nyquist_frequency_bears_the_whole_samples_that_eigenvalues_allow():
    found = margins(control.ss(0.0, 1.0, 0.2, 1.5, 0.1))
    assert found.stable
    assert found.delay_margin_samples.value == 0.0
    assert "unstable at n = 1" in found.delay_margin_samples.confirmed_by


def test_a_lightly_damped_resonance_is_not_missed():
    zeta, omega = 1e-5, 33.3
    loop = control.tf([0.002 * omega**2], [1, 2 * zeta * omega, omega**2]) + control.tf([1.0], [1.0, 0.0])
    found = margins(loop)
    peaks = [c.frequency.value for c in found.gain_crossovers]
    assert len(peaks) == 3
    assert sum(abs(w / omega - 1) < 0.01 for w in peaks) == 2
    s = 1j * peaks[-1]
    assert abs(0.002 * omega**2 / (s**2 + 2 * zeta * omega * s + omega**2) + 1 / s) == pytest.approx(1.0, abs=1e-9)


def test_all_crossings_of_a_conditionally_stable_loop_are_listed():
    loop = control.tf(np.poly([-1, -1]) * 40, np.polymul([1, 0, 0, 0], np.poly([-10, -10]) / 10))
    found = margins(loop)
    ratio = [c.gain_margin.value for c in found.phase_crossovers]
    assert len(ratio) == 2
    for c in found.phase_crossovers:
        value = loop(1j * c.frequency.value)
        assert abs(value.imag) < 1e-9 * abs(value)
        assert -1 / value.real == pytest.approx(c.gain_margin.value, rel=1e-9)
    assert found.stable
    assert (found.gain_margin_low.value, found.gain_margin_high.value) == tuple(ratio)


# --- what is not stable, not minimal, not given well --------------------------------------------------------------------


def test_an_unstable_closed_loop_has_no_margins_but_crossings_and_poles():
    found = margins(triple(20.0) * 0.1)
    assert not found.stable
    assert all(np.isnan(n.value) for n in found.numbers().values())
    assert "not stable: 2 of its poles" in found.phase_margin_deg.confirmed_by
    assert found.gain_crossovers
    assert sum(p.real > 0 for p in found.closed_loop_poles) == found.encirclements == 2


@pytest.mark.parametrize("sampled", [False, True])
def test_an_unstable_closed_loop_prints_its_poles_in_place_of_margins(sampled):
    # 4/(s(s + 2)) (s → −s for damping below 0) behind a hold of 10 ms: closed loop by hand
    a, k, T = (2.0, 200.0, 0.01) if sampled else (-2.0, 1.0, 0.0)
    if sampled:
        e = np.exp(-a * T)
        A, B = np.array([[1, (1 - e) / a], [0, e]]), 4 * np.array([[(T - (1 - e) / a) / a], [(1 - e) / a]])
    else:
        A, B = np.array([[0, 1], [0, -a]]), np.array([[0], [4.0]])
    poles = np.linalg.eigvals(A - k * B @ [[1, 0]])
    found = margins(control.ss(A, B, [[k, 0]], [[0.0]], T))
    lines = str(found).splitlines()
    assert lines[0] == "margins: none, as the closed loop is unstable"
    assert "nan" not in str(found)
    assert sorted(found.unstable_poles, key=np.imag) == pytest.approx(sorted(poles, key=np.imag))
    assert all(f"{p:.5g}"[:6] in lines[1] for p in poles)
    assert ("|z| < 1" if sampled else "Re s < 0") in lines[1]


def test_a_stable_loop_has_no_unstable_poles_and_prints_its_margins():
    found = margins(triple(20.0))
    assert found.unstable_poles == ()
    assert "\ngain_margin_low" in str(found)
    assert "unstable" not in str(found)


def test_a_closed_loop_on_the_limit_is_not_called_stable_by_rounding():
    loop = control.ss(np.diag([-1.0, 1.0]), [[2.063406], [2.063406]], [[-2.557134, 2.557134]], 2.0)  # L real for all ω
    found = margins(loop)
    assert not found.stable
    assert max(abs(p.real) for p in found.closed_loop_poles) < 1e-12


def test_two_crossings_between_two_samples_are_found_by_the_slope():
    r = Realization.of(control.tf([1.05 * 0.2 * 5, 0.0], [1, 0.2 * 5, 25]))  # |L| = 1.05 at 5 rad/s, nothing else
    scan = LoopScan(r)
    assert len(scan.find_gain_crossovers()) == 2
    scan.segments = [np.array([0.5, 4.0, 6.0, 50.0])]
    scan.samples = [(L, dL * w) for w, (L, dL) in zip(scan.segments, map(r.response, scan.segments), strict=True)]
    assert np.all(np.abs(scan.samples[0][0]) < 1)
    assert [c.omega for c in scan.find_gain_crossovers()] == pytest.approx(
        [c.omega for c in LoopScan(r).find_gain_crossovers()]
    )


def test_hidden_modes_are_split_off_and_named():
    loop = sampled_triple(20.0)
    A = np.zeros((5, 5))
    A[:3, :3], A[3, 3], A[4, 4] = loop.A, 1.0, 0.5
    A[3, 0] = 0.3  # a state at z = 1 that is driven and not seen, and one that is seen and not driven
    B, C = np.vstack([loop.B, [[1.0], [0.0]]]), np.hstack([loop.C, [[0.0, 2.0]]])
    found = margins(control.ss(A, B, C, 0, 1e-3))
    assert sorted(np.real(found.hidden_poles)) == pytest.approx([0.5, 1.0], abs=1e-9)
    close(found.phase_margin_deg, margins(loop).phase_margin_deg.value, 1e-8)


def test_hidden_modes_of_a_rotated_realization_are_split_off_too():
    loop, extra = control.tf([30.0, 20], [1, 3, 2, 0]), control.ss(-5.0, 1.0, 0.0, 0.0)
    system = control.ss(loop) + extra
    Q, _ = np.linalg.qr(np.random.default_rng(2).normal(size=(4, 4)))
    found = margins(control.ss(Q @ system.A @ Q.T, Q @ system.B, system.C @ Q.T, 0))
    assert np.real(found.hidden_poles) == pytest.approx([-5.0], abs=1e-9)
    close(found.phase_margin_deg, margins(loop).phase_margin_deg.value, 1e-9)


def test_a_state_that_is_not_seen_does_not_cost_three_integrators_their_accuracy():
    loop = sampled_triple(20.0)
    A = np.zeros((4, 4))
    A[:3, :3] = loop.A
    found = margins(control.ss(A, np.vstack([loop.B, [[1.0]]]), np.hstack([loop.C, [[0.0]]]), 0, 1e-3))
    assert found.hidden_poles == pytest.approx([0.0], abs=1e-14)
    assert found.phase_margin_deg.value == pytest.approx(margins(loop).phase_margin_deg.value, rel=1e-12)


@pytest.mark.parametrize("noise", [0.0, 1e-16, 1e-14, 1e-12])
def test_states_at_one_that_only_rounding_couples_do_not_make_a_loop_unstable(noise):
    loop, rng, T = sampled_triple(20.0), np.random.default_rng(0), 1e-3
    other = sampled_triple(40.0)
    A = np.eye(8)
    A[:3, :3], A[3:6, 3:6], A[6, 6] = loop.A, other.A - other.B @ other.C, 0.0
    A, B = A + noise * rng.normal(size=(8, 8)), np.vstack([loop.B, np.zeros((5, 1))]) + noise * rng.normal(size=(8, 1))
    C = np.hstack([loop.C, np.zeros((1, 5))]) + noise * rng.normal(size=(1, 8))
    found = margins(control.ss(A, B, C, 0, T))
    assert found.stable
    assert len(found.hidden_poles) == 5
    assert found.phase_margin_deg.value == pytest.approx(margins(loop).phase_margin_deg.value, abs=1e-8 + 1e7 * noise)


@pytest.mark.parametrize(
    ("loop", "options", "message"),
    [
        (control.ss(-1, 1, 1, 0, True), {}, r"found dt=True; expected 0 \(continuous\) or the sample time"),
        (control.ss(-np.eye(2), np.eye(2), np.eye(2), 0), {}, "2 inputs and 2 outputs.*Use mimo_disk_margin"),
        (control.ss(-1, 1, 1, 0), {"delay": 1}, "delay of 1 samples; expected a whole number.*0 for a continuous loop"),
        (control.ss(0.5, 1, 1, 0, 0.1), {"delay": 0.5}, "delay of 0.5 samples"),
        (control.ss(-1, 1, 0, 2), {}, "the constant 2: no state is controllable and observable"),
        (control.ss(-1, 1, 1, -1), {}, "L = −1 at infinite frequency"),
        ("L", {}, r"loop: found 'L'; expected the loop at a wire. Give diagram\.linearize\(\)\.loop\('L'\)"),
    ],
)
def test_a_loop_that_has_no_margins_is_refused_with_a_next_step(loop, options, message):
    with pytest.raises(ParameterError, match=message):
        margins(loop, **options)


def test_every_number_says_its_unit_tolerance_and_confirmation_and_goes_into_json():
    found = json.loads(json.dumps(margins(sampled_triple(20.0)).as_dict()))
    assert set(found) >= {
        "phase_margin_deg",
        "gain_margin_low",
        "gain_margin_high",
        "delay_margin_s",
        "disk_margin",
        "ms",
    }
    for leaf in found.values():
        assert set(leaf) == {"value", "unit", "tolerance", "confirmed_by"}
    assert found["phase_margin_deg"]["unit"] == "deg"
    assert re.search(r"^phase_margin_deg +69.5601  deg$", str(margins(sampled_triple(20.0))), re.MULTILINE)


# --- confirmations can fail ---------------------------------------------------------------------------------------------


def test_a_wrong_limit_is_not_confirmed():
    r = Realization.of(triple(20.0))
    with pytest.raises(ConfirmationError, match="found the limit 0.12, but eigenvalues say stable at .* and stable at"):
        scan_refine_confirm.confirm_limit("gain_margin_low", 0.12, [], 1.0, r.is_stable, "eigenvalues")
    with pytest.raises(ConfirmationError, match="found no limit, but eigenvalues say unstable at 0.1"):
        scan_refine_confirm.confirm_no_limit("gain_margin_low", [0.5, 0.1], r.is_stable, "eigenvalues")
    assert issubclass(ConfirmationError, LoopwrightError)


@pytest.mark.parametrize("wrong", [0.99, 1.01])
def test_a_wrong_peak_is_not_confirmed(wrong):
    r = Realization.of(triple(20.0))
    assert "the peak reaches 0.999" in confirm_peak(r, 0.0, 1.0, 9 / 7, "mt")
    with pytest.raises(ConfirmationError, match="found the peak"):
        confirm_peak(r, 0.0, 1.0, 9 / 7 * wrong, "mt")


@pytest.mark.parametrize("what", ["gain", "phase", "delay", "peak", "bandwidth"])
def test_a_scan_that_goes_wrong_is_an_error(what, monkeypatch):
    def off(self):
        return [loop_scan.Crossing(c.omega * 1.05, c.L * 1.05, c.slope, c.error) for c in real(self)]

    if what in ("gain", "phase"):
        real = getattr(loop_scan.LoopScan, f"find_{what}_crossovers")
        monkeypatch.setattr(loop_scan.LoopScan, f"find_{what}_crossovers", off)
    elif what == "delay":
        real = loop_scan.LoopScan.find_gain_crossovers
        monkeypatch.setattr(confirmations.ByEigenvalues, "confirm_crossing", lambda *_: "")
        monkeypatch.setattr(
            loop_scan.LoopScan,
            "find_gain_crossovers",
            lambda self: [loop_scan.Crossing(c.omega * 1.05, c.L, c.slope, c.error) for c in real(self)],
        )
    elif what == "peak":
        peak = loop_scan.LoopScan.find_peak
        monkeypatch.setattr(
            loop_scan.LoopScan, "find_peak", lambda *a: loop_scan.Peak(peak(*a).value * 0.99, peak(*a).omega)
        )
    else:
        fall = loop_scan.LoopScan.find_fall_below
        monkeypatch.setattr(loop_scan.LoopScan, "find_fall_below", lambda *a: fall(*a) * 1.01)
    with pytest.raises(ConfirmationError):
        margins(triple(20.0))


# --- random loops -------------------------------------------------------------------------------------------------------


def check(loop):
    """Margins by brute force on eigenvalues, at both sides of each; return whether the loop has any."""
    found = margins(loop)  # every number was confirmed, or this raises
    A, B, C, D, dt = loop.A, loop.B, loop.C, loop.D, loop.dt

    def stable(k):
        values = np.linalg.eigvals(A - k / (1 + k * D[0, 0]) * B @ C)
        return bool(np.all(np.abs(values) < 1) if dt else np.all(values.real < 0))

    if not found.stable or len(found.hidden_poles):
        return False
    assert stable(1.0)
    low, high, phase = found.gain_margin_low.value, found.gain_margin_high.value, found.phase_margin_deg.value
    within = 0.999  # of the way from 1 to a limit, by factors: margins may be nearer to 1 than that
    for k in np.concatenate(
        [np.geomspace(max(low, 1e-3) ** within, 1, 9), np.geomspace(1, min(high, 1e3) ** within, 9)]
    ):
        assert stable(k), k
    for phi in np.linspace(0, min(phase, 180) * 0.999, 9):
        assert stable(np.exp(-1j * np.radians(phi))), phi
    assert not (low > 0 and stable(low * 0.999))
    assert not (np.isfinite(high) and stable(high * 1.001))
    assert not (phase < 180 and all(stable(np.exp(sign * 1.001j * np.radians(phase))) for sign in (-1, 1)))

    def response(omega):
        s = np.exp(1j * omega * dt) if dt else 1j * omega
        return (C @ np.linalg.solve(s * np.eye(len(A)) - A, B) + D)[0, 0]

    omega = np.geomspace(1e-3, np.pi / dt if dt else 1e4, 500)[:-1]
    peaks = {
        "ms": lambda L: abs(1 / (1 + L)),
        "mt": lambda L: abs(L / (1 + L)),
        "disk_margin": lambda L: abs((1 - L) / (1 + L)),
    }
    for name, size in peaks.items():
        value = getattr(found, name).value
        largest = 2 / value if name == "disk_margin" else value
        assert max(size(response(w)) for w in omega) <= largest * (1 + 1e-6), name
        if name != "disk_margin" and np.isfinite(at := getattr(found, f"{name}_frequency").value) and at > 0:
            assert size(response(at)) == pytest.approx(largest, rel=1e-6), name
    return True


def test_margins_that_are_nearer_than_a_thousandth_are_confirmed():
    A = [[-534.80729627, 648.78480916, 0.0], [-648.78480916, 749.78662587, 0.0], [0.0, 0.0, 0.95122942]]
    C = [[786.211415, -670.492397, 1.81214844e-05]]
    assert check(control.ss(A, [[1.23693659], [1.12977513], [0.04877058]], C, 0.0, 0.05))


@random_cases(4, 200, open_loops(sampled=False), reaching=0.1)
def test_margins_of_random_continuous_loops_are_confirmed(loop):
    return check(loop)


@random_cases(4, 200, open_loops(sampled=True), reaching=0.1)
def test_margins_of_random_sampled_loops_are_confirmed(loop):
    return check(loop)


@pytest.mark.slow
@random_cases(6, 60, stabilized_loops(sampled=False), reaching=0.5)
def test_margins_of_random_continuous_state_feedbacks_are_confirmed(loop):
    return check(loop)


@random_cases(3, 60, stabilized_loops(sampled=True), reaching=0.5)
def test_margins_of_random_sampled_state_feedbacks_are_confirmed(loop):
    return check(loop)


@random_cases(30, 200, open_loops(sampled=True), reaching=0.5)
def test_encirclements_and_open_loop_poles_give_the_closed_loop_poles(loop):
    A, B, C, D = loop.A, loop.B, loop.C, loop.D
    closed = np.abs(np.linalg.eigvals(A - B @ C / (1 + D[0, 0]))) - 1
    if np.abs(closed).min() <= 1e-6:  # on the limit, hidden modes among them
        return False
    assert nyquist_count(loop).closed_loop == int(np.sum(closed > 0))
    return True


def test_rounding_in_a_chain_of_integrators_is_not_scaled_up_to_be_seen():
    # (3p s² + 3p² s + p³)/s³ as a reduction left it: A alone has no loop but one by rounding, 1e-14
    A = [[3.1e-16, -1.56e-15, 1.379e-14], [32.0, -1.85e-16, -2.2e-30], [5.4e-31, 8.99645162, 2.4e-15]]
    found = margins(control.ss(A, [[14.2278318], [0.0], [0.0]], [[8.43417339, 10.54271674, 15.625]], 0.0))
    assert found.gain_margin_low.value == pytest.approx(1 / 9, abs=1e-6)
    assert [c.frequency.value > 1.0 for c in found.phase_crossovers] == [True]


@pytest.mark.parametrize("apart", [0, 1, 3])
def test_samples_so_close_to_a_crossing_that_both_are_rounding_find_it(apart):
    # (60 s² + 1200 s + 8000)/s³ crosses the negative real axis at √(400/3) rad/s, beside which its zeros put samples
    scan = LoopScan(Realization.of(control.tf([60.0, 1200.0, 8000.0], [1.0, 0.0, 0.0, 0.0])))
    at = np.sqrt(400 / 3)
    close = at * (1 + np.finfo(float).eps * np.unique([-apart, apart]))
    scan.segments = [
        np.unique(np.append(part, close[(close > part[0]) & (close < part[-1])])) for part in scan.segments
    ]
    scan.samples = [scan._response(omega) for omega in scan.segments]
    found = [c.omega for c in scan.find_phase_crossovers()]
    assert found == pytest.approx([at], rel=1e-11)


def test_a_crossing_at_the_highest_frequency_with_a_large_factor_is_confirmed():
    # −0.02/(s² − 1.98 s + 1) sampled: its zero is at −1.003, so that L(−1) is −2e-10, and the closed loop with −1/L(−1)
    # has the poles 1219 and −1 of a matrix of norm 5e7
    M = expm(np.array([[0.0, 1.0, 1.0], [-1.0, 1.98, 1.0], [0.0, 0.0, 0.0]]) * 0.005)
    loop = control.ss(M[:2, :2], M[:2, 2:], [[-1.0, 1.0]], 0.0, 0.005)
    (a, b), (c, d) = [[-Fraction(float(v)) - (i == j) for j, v in enumerate(row)] for i, row in enumerate(loop.A)]
    u, v = (Fraction(float(value)) for value in loop.B[:, 0])
    L = (a * v - c * u - (d * u - b * v)) / (a * d - b * c)  # C (z I − A)⁻¹ B at z = −1, exactly
    found = margins(loop).phase_crossovers[-1]
    assert found.frequency.value == pytest.approx(np.pi / 0.005, rel=1e-14)
    assert found.gain_margin.value == pytest.approx(float(-1 / L), abs=found.gain_margin.tolerance)
    assert found.gain_margin.tolerance < 1e-5 * found.gain_margin.value


def test_a_delay_margin_of_exactly_one_sample_is_confirmed():
    # L = 1/(z − 1): with a sample of delay z² − z + 1, on the unit circle at ±60°; with two z³ − z² + 1, outside
    found = margins(control.ss(control.tf([1.0], [1.0, -1.0], 0.1)))
    assert found.delay_margin_samples.value == pytest.approx(1.0, abs=1e-12)
    assert found.delay_margin_s.value == pytest.approx(0.1, abs=1e-13)
    assert "on the limit at n = 1" in found.delay_margin_samples.confirmed_by
    with pytest.raises(ConfirmationError, match="no closed-loop pole is nearer"):
        confirmations.ByEigenvalues(Realization.of(control.tf([0.9], [1.0, -1.0], 0.1))).confirm_on_limit(1)


@pytest.mark.parametrize(("dt", "pole"), [(0, 2.0), (0.1, 1.2)])
def test_a_hidden_mode_that_is_not_stable_is_named_beside_stable(dt, pole):
    loop = control.ss(np.diag([0.5 - (dt == 0), pole]), [[0.3], [0.0]], [[1.0, 1.0]], 0, dt)
    found = margins(loop)
    assert found.stable
    assert np.real(found.hidden_unstable) == pytest.approx([pole], rel=1e-12)
    assert "hidden_unstable" in str(found)


def test_hidden_integrators_that_rounding_scatters_are_not_called_unstable():
    A = np.zeros((4, 4))
    A[0, 0] = 0.5
    A[1:, 1:] = np.eye(3) + np.diag([1.0, 1.0], 1)
    Q, _ = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))
    A[1:, 1:] = Q @ A[1:, 1:] @ Q.T
    found = margins(control.ss(A, [[0.3], [0], [0], [0]], [[1.0, 1.0, 0, 0]], 0, 0.1))
    assert len(found.hidden_poles) == 3
    assert np.abs(found.hidden_poles).max() > 1 + 1e-7  # scattered to both sides
    assert found.hidden_unstable == ()


@pytest.mark.parametrize(("w", "seed"), [(5.0, 1), (1.0, 2), (3.0, 4), (2.0, 6)])
def test_rounding_beside_an_undamped_pole_is_no_crossing(w, seed, disturbance):
    """L = 0.2 w/(s² + w²) + 1/s: by Routh, the closed loop is stable with every gain."""
    with disturbance.on(seed):
        L = control.ss([[0, w, 0], [-w, 0, 0], [0, 0, 0]], [[0], [1], [1]], [[0.2, 0, 1]], 0)
        found = margins(L)
    assert found.phase_crossovers == ()
    assert (found.gain_margin_low.value, found.gain_margin_high.value) == (0.0, np.inf)


@pytest.mark.parametrize("w0", [1.0, 2.0, 37.3])
def test_two_undamped_poles_in_one_place(w0):
    """L = 4 s (s² + s + 1)/(s² + 1)² closes to (s + 1)⁴, and to a stable loop with every gain; s in parts of w0."""
    numerator = np.array([4.0, 4.0, 4.0, 0.0]) * w0 ** np.arange(1, 5)
    loop = control.tf(numerator, np.array([1.0, 0.0, 2.0, 0.0, 1.0]) * w0 ** np.arange(5))
    found = margins(loop)
    assert found.stable
    assert (found.gain_margin_low.value, found.gain_margin_high.value) == (0.0, np.inf)
    assert found.ms.value == pytest.approx(1.0, abs=1e-9)
    # |L| = 1 with w = ω²: (1 − w)⁴ = 16 w (w + (1 − w)²)
    one = np.array([-1.0, 1.0])
    square = np.polymul(one, one)
    w = np.roots(np.polysub(np.polymul(square, square), np.polymul([16.0, 0.0], np.polyadd(square, [1.0, 0.0]))))
    omega = np.sqrt(np.sort(w.real[(abs(w.imag) < 1e-9) & (w.real > 0)]))
    assert [c.frequency.value for c in found.gain_crossovers] == pytest.approx(w0 * omega, rel=1e-9)
    phases = np.degrees(np.angle(-1.0 / (4j * omega * (1 - omega**2 + 1j * omega) / (1 - omega**2) ** 2)))
    assert found.phase_margin_deg.value == pytest.approx(abs(phases).min(), rel=1e-9)
    assert nyquist_count(loop).closed_loop == 0


@pytest.mark.parametrize("gain", [1.0, 2.0, 0.7])
def test_encirclements_of_a_curve_through_minus_one_are_not_counted(gain):
    """s² + 1 + k = 0: rounding alone decides on which side of −1 the curve passes."""
    for denominator in ([1.0, 0.0, 1.0], [1.0, 0.0, 0.0]):
        with pytest.raises(ConfirmationError, match=r"a closed-loop pole on the limit of stability, s = "):
            nyquist_count(control.tf([gain], denominator))
    sampled = control.tf([gain], [1.0, -1.0 - gain], 0.1)  # closes to z = 1
    with pytest.raises(ConfirmationError, match=r"a closed-loop pole on the limit of stability, z = 1\+0j"):
        nyquist_count(sampled)


@pytest.mark.parametrize(("pole", "gain"), [(0.3, 0.1 + 0.2), (0.1 + 0.2, 0.3), (0.3, 0.3)])
@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_a_closed_loop_pole_that_is_the_rounding_of_a_difference_is_on_the_limit(pole, gain, dt):
    """L = k/(s − a), closed at s = a − k, which is 0 or 6e-17 to either side."""
    loop = control.ss([[1.0 + pole if dt else pole]], [[1.0]], [[gain]], 0.0, dt)
    found = margins(loop)
    assert not found.stable
    assert found.unstable_poles == found.closed_loop_poles
    with pytest.raises(ConfirmationError, match="a closed-loop pole on the limit of stability"):
        nyquist_count(loop)


def test_gain_margins_have_decibels_next_to_the_factor_in_texts_and_on_pages():
    from loopwright.diagrams.report.pages.printed_values import quantity

    found = margins(control.tf([0.6], [1.0, 2.0, 1.0, 0.0]))  # −180° at 1 rad/s, where |L| = 0.6/2
    high = found.gain_margin_high
    assert str(high) == "3.33333 (10.5 dB)"
    assert "gain_margin_high 3.33333 (10.5 dB)" in repr(found)
    assert quantity(high, 4) == "3.333 (10.5 dB)"
    assert [str(p.gain_margin) for p in found.phase_crossovers] == ["3.33333 (10.5 dB)"]
    assert (str(found.gain_margin_low), str(found.disk_margin)[-1].isdigit()) == ("0", True)
    low = margins(control.tf([4.0], [1.0, -1.0])).gain_margin_low  # k > 1/4
    assert quantity(low, 4) == "0.25 (−12 dB)"
    assert high.as_dict().keys() == {"value", "unit", "tolerance", "confirmed_by"}
