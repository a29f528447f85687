"""Transfer functions in z keep their digits near z = 1, where a companion form scatters multiple poles."""

from fractions import Fraction

import control
import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.optimize import brentq, minimize_scalar

from loopwright.diagrams import ConfirmationError
from loopwright.diagrams.frequency.state_space import read_matrices
from loopwright.frequency import margins
from support.random_cases import random_cases

P = 20.0


def held_triple(T, factor=1.0):
    """Return three integrators with a triple zero, P³(1 + s/P)³ − s³ over s³, behind a hold, as polynomials in z."""
    w = np.poly1d([1, -1])
    over = 3 * P * T * w * w + 3 * P**2 * T**2 / 2 * np.poly1d([1, 1]) * w + P**3 * T**3 / 6 * np.poly1d([1, 4, 1])
    return control.tf(factor * over.coeffs, factor * (w * w * w).coeffs, T)


def held_triple_states(T):
    """Return the same loop as a state space, with the matrix exponential of a chain of integrators written out."""
    A = np.array([[1, T, T * T / 2], [0, 1, T], [0, 0, 1]])
    return control.ss(A, [[T**3 / 6], [T * T / 2], [T]], [[P**3, 3 * P**2, 3 * P]], [[0.0]], T)


@pytest.mark.parametrize("T", [1e-2, 1e-4, 1e-5, 1e-6])
@pytest.mark.parametrize("factor", [1.0, 0.1])
@pytest.mark.drawn(2)
def test_three_integrators_sampled_fast_have_the_margins_of_their_state_space(T, factor):
    found, exact = margins(held_triple(T, factor)), margins(held_triple_states(T))
    # rounding of the numerator's coefficients, 3 P T each, relative to its value 3 P T (ω T)² at the crossing
    digits = 10 * np.finfo(float).eps / (P * T) ** 2
    assert found.stable
    for name in ("phase_margin_deg", "gain_margin_low", "mt", "bandwidth", "delay_margin_s"):
        one, other = found.numbers()[name].value, exact.numbers()[name].value
        assert one == pytest.approx(other, rel=max(1e-11, digits)), name
    for name in ("phase_margin_deg", "gain_margin_low"):
        number, other = found.numbers()[name], exact.numbers()[name]
        assert abs(number.value - other.value) <= number.tolerance + other.tolerance, name


def test_the_tolerance_counts_the_rounding_of_coefficients_where_it_shows():
    slow, fast = (margins(held_triple(T)).phase_margin_deg for T in (1e-2, 1e-6))
    assert slow.tolerance < 1e-9
    assert 1e-7 < fast.tolerance < 1e-2


def exact_value(numerator, denominator, z):
    """Return a transfer function at a rational z, in exact arithmetic."""

    def value(coefficients):
        return sum(Fraction(float(c)) * z**k for k, c in enumerate(reversed(np.atleast_1d(coefficients))))

    return float(value(numerator) / value(denominator))


def polynomials(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 6))
    poles = 1 - 10.0 ** rng.uniform(-4, 0, n)
    zeros = 1 - 10.0 ** rng.uniform(-4, 0, int(rng.integers(0, n + 1)))
    return rng.uniform(0.1, 9) * np.poly(zeros), rng.uniform(0.1, 9) * np.poly(poles)


@random_cases(12, 300, st.integers(0, 10**6))
def test_a_realization_has_the_values_of_the_polynomials_in_exact_arithmetic(seed):
    over, under = polynomials(seed)
    A, B, C, D, dt = read_matrices(control.tf(over, under, 0.1))
    assert dt == 0.1
    for z in (Fraction(3, 2), Fraction(-2), Fraction(33, 32)):
        got = (C @ np.linalg.solve(float(z) * np.eye(len(A)) - A, B) + D)[0, 0]
        assert got == pytest.approx(exact_value(over, under, z), rel=1e-11)


@pytest.mark.parametrize(
    "system",
    [
        control.tf([2.0], [4.0], 0.1),
        control.tf([1.0, 2.0], [1.0, 3.0]),
        control.tf([1.0], [1.0, 0.0, 0.0]),
        control.tf([1.0, 0.5], [1.0, -0.25], True),
    ],
    ids=["constant", "continuous", "double integrator", "open sample time"],
)
def test_other_forms_are_those_of_python_control(system):
    A, B, C, D, dt = read_matrices(system)
    theirs = control.ss(system)
    for p in (0.3 + 1j, 2.0):
        got = (C @ np.linalg.solve(p * np.eye(len(A)) - A, B) + D)[0, 0]
        assert got == pytest.approx(complex(theirs(p)), rel=1e-12)
    assert dt is system.dt or dt == system.dt


def test_an_equation_without_a_solution_is_an_error_with_a_next_step(monkeypatch):
    def singular(*args, **options):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr("loopwright.diagrams.frequency.loop_margins._LoopMarginFinder.find_margins", singular)
    with pytest.raises(ConfirmationError, match=r"margins: found an equation .* \(Singular matrix\); .*balanced"):
        margins(control.tf([1.0], [1.0, 1.0]))


@pytest.mark.slow
@pytest.mark.parametrize("gain", [0.01, 0.3])
@pytest.mark.parametrize("samples", [1, 14, 15, 16, 23, *(pytest.param(n, marks=pytest.mark.slow) for n in (40, 60))])
def test_a_delay_written_into_the_polynomials_has_the_margins_of_its_closed_form(samples, gain):
    """K/(zⁿ (z − 1)): |L| = K/(2 sin(θ/2)), and its phase is −π/2 − (n + 1/2) θ."""
    K, T = gain / (samples + 1), 0.01
    found = margins(control.tf([K], [1.0, -1.0, *[0.0] * samples], T))
    crossing = 2 * np.arcsin(K / 2)
    limit = np.pi / (2 * samples + 1)
    phase = np.pi / 2 - (samples + 0.5) * crossing
    exact = {"phase_margin_deg": np.degrees(phase), "gain_margin_high": 2 * np.sin(limit / 2) / K}
    exact["delay_margin_s"] = phase / crossing * T
    assert found.stable
    for name, value in exact.items():
        number = found.numbers()[name]
        assert number.value == pytest.approx(value, rel=1e-9), name
        assert abs(number.value - value) <= number.tolerance + 1e-13 * abs(value), name


def test_poles_at_zero_are_a_chain_of_delays():
    """A moving average of 30 samples, one beside a resonance, and a plant with a common factor z."""
    mean = np.ones(30) / 30
    cases = [
        (0.5 * mean, [1.0, *[0.0] * 29]),
        (0.5 * mean, [1.0, *[0.0] * 30]),
        (np.convolve(mean, [0.1, 0.2]), np.convolve([1.0, -1.9, 0.95], [1.0, *[0.0] * 29])),
        ([1.0, 2.0, 3.0], [2.0, 0.0, 0.0]),
        ([1.0, 0.5, 0.0], [1.0, -0.5, 0.0]),
        ([3.0], [2.0, 0.0]),
    ]
    for over, under in cases:
        A, B, C, D, _ = read_matrices(control.tf(over, under, 0.1))
        assert len(A) == len(under) - 1
        for z in (Fraction(9, 7), Fraction(-5, 4), Fraction(21, 20)):
            got = (C @ np.linalg.solve(float(z) * np.eye(len(A)) - A, B) + D).item()
            assert got == pytest.approx(exact_value(over, under, z), rel=1e-11)


@pytest.mark.slow
def test_a_filter_of_delays_alone_has_its_margins():
    """L = K (1 + z⁻¹ + … + z⁻²⁹)/30 · z⁻¹: at z = 1 it is K, and 1/M_t = 1 + 1/K there."""
    K = 0.5
    found = margins(control.tf(K * np.ones(30) / 30, [1.0, *[0.0] * 30], 0.01))
    theta = np.linspace(1e-6, np.pi, 20_001)

    def L(theta):
        return K * np.exp(-1j * theta) * (1 - np.exp(-30j * theta)) / (30 * (1 - np.exp(-1j * theta)))

    def least(f):
        k = int(np.argmin(f(theta)))
        return minimize_scalar(f, bounds=theta[[k - 1, k + 1]], method="bounded", options={"xatol": 1e-12}).fun

    assert found.ms.value == pytest.approx(1 / least(lambda x: np.abs(1 + L(x))), rel=1e-9)
    assert found.mt.value == pytest.approx(1 / least(lambda x: np.abs(1 + 1 / L(x))), rel=1e-9)


@pytest.mark.parametrize("T", [1e-4, 1e-5, 1e-6])
@pytest.mark.parametrize("form", ["as it is", "observable", "turned"])
@pytest.mark.drawn
def test_a_companion_form_of_integrators_that_are_sampled_fast_has_its_margins(T, form):
    """L = k (z − q)²/(z − 1)³ with q = 1 − P T, as `ss(zpk(…))` makes it: exact with w = z − 1 = exp(jωT) − 1."""
    P, k = 20.0, 60.0 * T
    made = control.ss(control.zpk([1 - P * T] * 2, [1, 1, 1], k, dt=T))
    if form == "observable":
        made = control.ss(made.A.T, made.C.T, made.B.T, made.D, T)
    if form == "turned":
        made = control.ss(made.A[::-1, ::-1], made.B[::-1], made.C[:, ::-1], made.D, T)

    def L(omega):
        w = np.expm1(1j * omega * T)
        return k * (w + P * T) ** 2 / w**3

    crossing = brentq(lambda w: abs(L(w)) - 1, 10.0, 1000.0, xtol=1e-12)
    phase = np.degrees(np.angle(-L(crossing)))
    found = margins(made)
    assert found.stable
    rounding = 10 * np.finfo(float).eps / (P * T) ** 2  # of the numerator's coefficients
    number = found.phase_margin_deg
    assert number.value == pytest.approx(phase, rel=max(1e-9, rounding))
    assert abs(number.value - phase) <= max(number.tolerance, 1e-12 * phase) < 1e-2
    peak = minimize_scalar(
        lambda w: -abs(1 / (1 + L(w))), bounds=(50.0, 500.0), method="bounded", options={"xatol": 1e-9}
    )
    assert found.ms.value == pytest.approx(-peak.fun, rel=max(1e-8, rounding))


def test_a_realization_without_digits_is_refused_with_a_next_step(monkeypatch):
    def singular(*args, **options):
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr("loopwright.diagrams.frequency.realization.Realization.reduce", singular)
    with pytest.raises(
        ConfirmationError, match=r"rig: found an equation .* \(Singular matrix\); .* transfer function\."
    ):
        margins(control.tf([1.0], [1.0, 1.0], name="rig"))
