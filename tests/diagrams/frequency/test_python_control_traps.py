"""Known traps of python-control 0.10.2, each with a loop for which our number is right and its own is not, or is none."""

import warnings

import control
import numpy as np
import pytest

from loopwright.blocks import ParameterError
from loopwright.diagrams.frequency.loop_scan import make_grid
from loopwright.diagrams.frequency.python_control_margins import _Judge, compare_margins, respond_at_once
from loopwright.diagrams.frequency.realization import Realization
from loopwright.frequency import compare_with_control, disk_margin, margins, nyquist_count, place
from support.loops import sampled_triple, triple

T = 1e-3


def delayed(p):
    return sampled_triple(p, T) * control.ss(0, 1, 1, 0, T)


def with_rounding(p):
    """The loop of a triple pole with a sample of delay, as the state space to transfer function of slycot 0.7.0 left it.

    Its rounding, 1e-15 in the denominator, scatters the three poles at z = 1 by 1e-5.
    """
    exact = control.tf(delayed(p))
    rounding = np.array([0.0, -8.88178420e-16, 8.88178420e-16, -6.66133815e-16, 3.62966743e-18])
    return control.tf(exact.num[0][0], exact.den[0][0] + rounding, T)


def phase_margin_by_eigenvalues(loop):
    """Bisection on the rotation at which a complex closed-loop matrix leaves the unit circle."""
    low, high = 0.0, 90.0
    for _ in range(60):
        middle = (low + high) / 2
        A = loop.A - np.exp(-1j * np.radians(middle)) * loop.B @ loop.C
        low, high = (middle, high) if np.abs(np.linalg.eigvals(A)).max() < 1 else (low, middle)
    return low


def rows(loop, **options):
    return {row.name: row for row in compare_with_control(loop, **options)}


def quiet(function, *arguments, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return function(*arguments, **options)


@pytest.mark.parametrize("states", [1, 2, 300])
@pytest.mark.parametrize("dt", [0, 0.1])
def test_responses_at_once_are_those_that_python_control_computes_one_by_one(states, dt):
    rng = np.random.default_rng(states)
    shapes = (states, states), (states, 1), (1, states), (1, 1)
    system = control.ss(*(rng.normal(size=shape) for shape in shapes), dt)
    points = rng.normal(size=5) + 1j * rng.normal(size=5)
    np.testing.assert_allclose(respond_at_once(system)(points), system(points), rtol=1e-9)
    assert respond_at_once(system)(points[0]) == pytest.approx(system(points[0]), rel=1e-9)


def test_responses_at_once_are_those_of_python_control_at_a_pole_too():
    for output in (1.0, 0.0):  # infinity, and NaN where a zero cancels the pole
        system = control.ss(np.diag([0.0, -1.0]), [[1.0], [1.0]], [[output, 1.0]], 0.0)
        at_once, one_by_one = (quiet(form, np.array([0.0, 1.0])) for form in (respond_at_once(system), system))
        np.testing.assert_array_equal(at_once, one_by_one)
        assert not np.isfinite(at_once[0])
        assert at_once[1] == pytest.approx(output + 0.5)


def test_rounding_in_a_denominator_moves_its_phase_margin_and_not_ours():
    right = phase_margin_by_eigenvalues(delayed(20.0))
    assert right == pytest.approx(66.06005, abs=1e-5)
    theirs = quiet(control.stability_margins, with_rounding(20.0))[1]
    assert abs(theirs - right) > 4  # 70.36° or more
    assert margins(with_rounding(20.0)).phase_margin_deg.value == pytest.approx(right, abs=1e-5)
    row = rows(with_rounding(20.0))["phase_margin_deg"]
    assert row.right == "ours"
    refuted = (
        "closed-loop eigenvalues say unstable just before it",
        "a rotation there ends stability",
    )  # by its rounding
    assert any(text in row.why for text in refuted)


def test_the_delay_margin_that_follows_from_it_is_wrong_as_well():
    row = rows(with_rounding(20.0))["delay_margin_s"]
    assert row.right == "ours"
    assert row.value == pytest.approx(margins(delayed(20.0)).delay_margin_s.value, rel=1e-6)
    assert not abs(row.control - row.value) <= 0.3 * row.value  # or none, as rounding has it


def test_the_answer_does_not_depend_on_the_basis_of_the_states():
    loop, rng = delayed(20.0), np.random.default_rng(3)
    right = phase_margin_by_eigenvalues(loop)
    theirs = []
    for _ in range(4):
        Q, _ = np.linalg.qr(rng.normal(size=(4, 4)))
        other = control.ss(Q @ loop.A @ Q.T, Q @ loop.B, loop.C @ Q.T, 0, T)
        found = margins(other)
        assert found.phase_margin_deg.value == pytest.approx(right, abs=1e-6)
        assert (len(found.gain_crossovers), len(found.phase_crossovers)) == (1, 2)
        theirs.append(quiet(control.stability_margins, other)[1])
    assert max(abs(pm - right) for pm in theirs) > 0.1


@pytest.mark.slow
def test_spurious_crossings_at_low_frequency_are_not_taken_for_margins():
    slow = delayed(0.2)  # the gain margins of this loop are those of its scale: 1/9 and 1/(3 p T), nearly
    found = margins(slow)
    assert len(found.gain_crossovers) == 1
    assert [c.gain_margin.value for c in found.phase_crossovers] == pytest.approx([1 / 9, 1 / (0.6 * T)], rel=1e-3)
    # python-control lists as many as its rounding makes; of a slower loop, one of them may be the headline
    slower = rows(sampled_triple(0.01))
    assert slower["gain_margin_high"].right == "ours"
    assert slower["gain_margin_high"].value == pytest.approx(2 / (0.03 * T), rel=1e-9)


def test_three_scattered_poles_at_one_are_one_cluster_below_which_nothing_is_read():
    r = Realization.of(with_rounding(20.0))
    features = r.features
    assert [(a.omega, a.multiplicity) for a in features.axis_poles] == [(0.0, 3)]
    assert features.axis_poles[0].scatter > 1e-3  # rad/s, where a triple pole is exact in the original matrices
    assert features.unstable_poles() == 0
    assert make_grid(r)[0][0] >= 30 * features.axis_poles[0].scatter


def test_its_polynomial_method_finds_a_gain_margin_of_two_where_there_are_sixteen_hundred():
    slow = delayed(0.2)
    listed = quiet(control.stability_margins, control.tf(slow), method="poly", returnall=True)[0]
    assert min(gm for gm in listed if gm > 1) < 30
    found = margins(slow)
    assert found.gain_margin_high.value == pytest.approx(1666.4999722, rel=1e-8)
    poles = [np.linalg.eigvals(slow.A - k * slow.B @ slow.C) for k in (2.2, 1650.0, 1680.0)]
    assert [bool(np.abs(z).max() < 1) for z in poles] == [True, True, False]


def test_a_gain_margin_at_the_nyquist_frequency_is_reported():
    listed = quiet(control.stability_margins, sampled_triple(20.0), returnall=True)[0]
    assert not any(abs(gm - 100 / 3) < 1 for gm in listed)
    row = rows(sampled_triple(20.0))["gain_margin_high"]
    assert row.value == pytest.approx(100 / 3, rel=1e-12)
    assert (row.right, np.isnan(row.control)) == ("ours", True)
    A = sampled_triple(20.0)
    radius = [np.abs(np.linalg.eigvals(A.A - k * A.B @ A.C)).max() for k in (33.3, 33.4)]
    assert radius[0] < 1 < radius[1]


@pytest.mark.slow
def test_the_headline_gain_margin_is_the_reduction_for_one_loop_and_the_increase_for_another():
    one, other = (quiet(control.stability_margins, delayed(p))[0] for p in (20.0, 40.0))
    assert one < 1 < other
    for p in (20.0, 40.0):
        found = margins(delayed(p))
        assert found.gain_margin_low.value < 1 < found.gain_margin_high.value
        assert sum(np.isnan(r.control) for r in compare_with_control(delayed(p)) if r.name.startswith("gain")) == 1


def test_encirclements_with_three_poles_at_one_are_those_of_the_eigenvalues():
    loop = with_rounding(20.0)
    assert quiet(control.nyquist_response, loop).count != 0
    count = nyquist_count(loop)
    assert (count.encirclements, count.open_loop, count.closed_loop) == (0, 0, 0)
    assert rows(loop)["encirclements"].right == "ours"
    assert nyquist_count(0.05 * loop).encirclements == 2


def test_the_bandwidth_is_that_of_half_the_power():
    # 1/(s + 1) closed over an integrator: |T| = 1/√2 at exactly 1 rad/s
    loop = control.ss(control.tf([1.0], [1.0, 0.0]))
    assert margins(loop).bandwidth.value == pytest.approx(1.0, rel=1e-9)
    assert abs(control.bandwidth(control.feedback(loop, 1)) - 1) > 1e-3
    row = rows(loop)["bandwidth"]
    assert row.right == "ours"
    assert "10^(−3/20)" in row.why


def test_the_bandwidth_of_a_sampled_loop_is_found_where_the_other_raises():
    row = rows(sampled_triple(20.0))["bandwidth"]
    assert row.right == "ours"
    assert "it raises ValueError" in row.why
    T = margins(sampled_triple(20.0)).bandwidth.value
    L = sampled_triple(20.0)(np.exp(1j * T * 1e-3))
    assert abs(L / (1 + L)) == pytest.approx(2**-0.5, rel=1e-9)


def test_a_disk_margin_gives_gains_as_factors_not_in_decibels():
    found = disk_margin(triple(20.0))
    _, decibels, _ = control.disk_margins(triple(20.0), np.geomspace(1, 1000, 2000))
    assert found.gain_high == pytest.approx(4.0, rel=1e-9)  # (2 + 1.2)/(2 - 1.2)
    assert decibels == pytest.approx(20 * np.log10(4.0), rel=1e-4)


def test_coinciding_poles_are_placed_where_the_other_refuses():
    A, B = np.diag([1.0, 1.0], 1), np.array([[0.0], [0.0], [1.0]])
    with pytest.raises(ValueError, match="repeated more than"):
        control.place(A, B, [-20.0] * 3)
    K = place(A, B, [-20.0] * 3)
    assert K[0] == pytest.approx([8000, 1200, 60], rel=1e-12)
    scatter = np.abs(np.linalg.eigvals(A - B @ K) + 20).max()
    assert scatter > 1e-5  # which is why polynomials are compared


def test_where_the_two_agree_it_says_so():
    found = rows(triple(20.0))
    assert {name for name, row in found.items() if row.right == "both"} >= {"gain_margin_low", "phase_margin_deg"}
    row = found["gain_margin_high"]
    assert (row.value, np.isnan(row.control), row.right) == (np.inf, True, "ours")  # it reports none
    assert all(row.right != "neither is refuted" for row in found.values())


def test_an_unstable_loop_is_compared_only_in_crossings():
    with pytest.raises(ParameterError, match="not stable"):
        compare_with_control(0.1 * triple(20.0))


@pytest.mark.parametrize("gain", [1.0, 5.0, 10.0, 15.0])
def test_a_gain_margin_that_it_calls_infinite_is_refuted_by_ours(gain):
    loop = control.ss(control.tf([0.1 * gain], [1.0, -1.0], 0.1))  # an integrator under a sampled gain: z = 1 − g T
    theirs = quiet(control.stability_margins, loop)[0]
    assert theirs == np.inf or theirs < 1e-12  # as rounding has it
    row = rows(loop)["gain_margin_high"]
    assert row.value == pytest.approx(20.0 / gain, rel=1e-12)
    assert row.right == "ours"
    if theirs == np.inf:
        assert f"the factor {20.0 / gain:.9g} ends stability" in row.why


def test_a_value_that_cannot_be_judged_does_not_end_the_comparison(monkeypatch):
    def fails(*args):
        raise np.linalg.LinAlgError("did not converge")

    monkeypatch.setattr(_Judge, "_refute", fails)
    monkeypatch.setattr(control, "stability_margins", lambda loop: (np.inf,) * 6)
    row = rows(control.ss(control.tf([0.1], [1.0, -1.0], 0.1)))["gain_margin_high"]
    assert row.right == "neither is refuted"
    assert "did not converge" in row.why


def test_margins_that_are_there_are_compared_without_a_second_reduction(monkeypatch):
    loop = triple(20.0)
    ours = margins(loop)
    monkeypatch.setattr("loopwright.diagrams.frequency.python_control_margins.margins", None)
    found = compare_margins(Realization.of(loop), ours, loop)
    assert {row.name for row in found} >= {"gain_margin_low", "phase_margin_deg"}


@pytest.mark.parametrize("damping", [0.05, 0.003])
@pytest.mark.parametrize("period", [0.0, 0.1])
@pytest.mark.drawn(1)
def test_its_disk_margin_is_asked_for_at_the_frequencies_where_it_is_least(damping, period):
    """An integrator before a resonance: a peak as wide as the damping is asked for where it is, and the tools agree."""
    loop = control.ss(control.tf([1.8 * damping], [1, 0]) * control.tf([1], [1, 2 * damping, 1]))
    row = rows(control.sample_system(loop, period) if period else loop)["disk_margin"]
    assert row.right == "both"
    assert row.control == pytest.approx(row.value, rel=1e-7)


def test_its_negative_phase_margin_is_ours_the_other_way():
    """At the crossover of 3.5 (s + 0.5)(s − 1.5)/((s + 3)(s + 1)²) a lead ends stability; a real loop bears as much lag."""
    loop = control.ss(control.zpk([-0.5, 1.5], [-3.0, -1.0, -1.0], 3.5))
    row = rows(loop)["phase_margin_deg"]
    assert row.control == pytest.approx(-row.value, rel=1e-6)
    assert row.right == "both"
    assert "sign" in row.why
