"""Pole placement: multiple poles, several inputs, and what a sampled PID loop really has and can be given."""

import control
import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.linalg import expm

from loopwright.blocks import ErrorDynamics, ParameterError
from loopwright.diagrams import ConfirmationError
from loopwright.diagrams.frequency import pole_placement as placement
from loopwright.frequency import delayed_hold, place, sampled_gains, sampled_poles
from support.random_cases import random_cases


def same_polynomial(A, poles, relative=1e-7):
    wanted = np.real(np.poly(poles))
    size = np.abs(poles).max() ** np.arange(len(wanted))
    return np.max(np.abs(np.poly(A) - wanted) / size) < relative * np.max(np.abs(wanted) / size)


@pytest.mark.parametrize("p", [1.0, 20.0, 40.0, 1e3])
def test_the_gains_of_a_triple_pole_are_those_of_the_error_dynamics(p):
    A, B = np.array([[0.0, 1, 0], [0, 0, 1], [0, 0, 0]]), np.array([[0.0], [0], [1]])
    block = ErrorDynamics.from_poles([-p] * 3)
    assert place(A, B, [-p] * 3)[0] == pytest.approx(
        [block.a0, block.a1, block.a2], rel=1e-12 + 1e-15 * p**2
    )  # 1e-16 of a0 in a2


@pytest.mark.parametrize("n", [2, 4, 6])
def test_all_poles_in_one_place_are_placed_for_a_single_input(n):
    rng = np.random.default_rng(n)
    A, B = rng.normal(size=(n, n)) * 5, rng.normal(size=(n, 1))
    assert same_polynomial(A - B @ place(A, B, [-4.0] * n), [-4.0] * n)


def test_dead_beat_is_a_multiple_pole_at_zero():
    A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([0.005, 0.1])
    closed = A - np.outer(B, place(A, B, [0.0, 0.0]))
    assert np.linalg.matrix_power(closed, 2) == pytest.approx(np.zeros((2, 2)), abs=1e-12)


def test_two_axes_are_not_coupled_by_placing_all_their_poles_in_one_place():
    A, B = np.kron(np.eye(2), np.diag([1.0, 1.0], 1)), np.kron(np.eye(2), [[0.0], [0.0], [1.0]])
    row = [8000.0, 1200.0, 60.0]
    assert place(A, B, [-20.0] * 6) == pytest.approx(np.kron(np.eye(2), row), abs=1e-9)


@pytest.mark.parametrize(
    "poles",
    [
        [-5, -5, -5, -5, -5, -5],
        [-5, -5, -3 + 1j, -3 - 1j, -1, -2],
        [-5, -5, -5, -3 + 1j, -3 - 1j, -2],
        [-2 + 1j, -2 - 1j] * 3,
        [-1, -2, -3, -4, -5, -6],
    ],
)
@pytest.mark.parametrize("inputs", [1, 2, 3])
def test_any_multiplicity_is_placed_for_any_number_of_inputs(poles, inputs):
    rng = np.random.default_rng(7)
    A, B = rng.normal(size=(6, 6)) * 3, rng.normal(size=(6, inputs))
    assert same_polynomial(A - B @ place(A, B, poles), poles, 1e-6)


def test_dependent_inputs_are_one_input():
    A, b = np.diag([1.0, 1.0], 1), np.array([[0.0], [0.0], [1.0]])
    B = np.hstack([b, 2 * b])
    assert same_polynomial(A - B @ place(A, B, [-3.0] * 3), [-3.0] * 3)


@random_cases(60, 400, st.integers(1, 5), st.integers(1, 3), st.integers(0, 10_000), st.booleans())
def test_random_systems_get_the_polynomial_that_was_asked_for(n, m, seed, twice):
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, m))
    poles = -rng.uniform(0.5, 3, n)
    if twice and n > 1:
        poles[1:] = poles[0]
    assert same_polynomial(A - B @ place(A, B, poles), poles, 1e-5)


@pytest.mark.parametrize(
    ("A", "B", "poles", "message"),
    [
        (np.diag([1.0, 2.0]), [[1.0], [0.0]], [-1, -2], r"mode at 2(\+0j)? that no input reaches"),
        (np.diag([1.0, 2.0]), [[1.0], [1.0]], [-1], r"found A \(2, 2\), B \(2, 1\) and 1 poles"),
        (np.diag([1.0, 2.0]), [[1.0], [1.0]], [-1 + 1j, -2], "expected complex ones in conjugate pairs"),
    ],
)
def test_what_can_not_be_placed_is_refused(A, B, poles, message):
    with pytest.raises(ParameterError, match=message):
        place(A, B, poles)


def test_a_gain_that_does_not_place_the_poles_is_an_error(monkeypatch):
    monkeypatch.setattr(placement, "_place_in_chains", lambda *_: np.array([[8000.0, 1200.0, 60.1]]))
    A, B = np.diag([1.0, 1.0], 1), np.array([[0.0], [0.0], [1.0]])
    with pytest.raises(ConfirmationError, match="differs from the wanted one"):
        place(A, B, [-20.0] * 3)


# --- sampled ------------------------------------------------------------------------------------------------------------


def closed_loop(gains, T, delay, integral, chain=2):
    """Transition matrix of chain, sum and delay line, by the matrix exponential: states x, ∫e, commands underway."""
    A = np.diag(np.ones(chain - 1), 1)
    B = np.eye(chain)[:, -1:]
    both = expm(np.block([[A, B], [np.zeros((1, chain + 1))]]) * T)
    n = chain + 1 + delay
    M = np.zeros((n, n))
    M[:chain, :chain] = both[:chain, :chain]
    M[chain, [0, chain]] = T, 1.0
    weight = {"forward": 0.0, "trapezoidal": 0.5, "backward": 1.0}[integral]
    v = np.zeros(n)
    v[:chain] -= gains[1:]
    v[chain] -= gains[0]
    v[0] -= gains[0] * weight * T
    if delay:
        M[:chain, -1:] = both[:chain, chain:]
        M[chain + 1] = v
        for k in range(1, delay):
            M[chain + 1 + k, chain + k] = 1.0
    else:
        M[:chain] += both[:chain, chain:] @ v[None, :]
    return M


@pytest.mark.parametrize("integral", ["forward", "backward", "trapezoidal"])
@pytest.mark.parametrize("delay", [0, 1, 2, 5])
@pytest.mark.parametrize("chain", [1, 2, 3])
def test_sampled_poles_are_those_of_the_transition_matrix(chain, delay, integral):
    T, p = 0.01, 4.0
    gains = np.real(np.poly([-p] * (chain + 1)))[:0:-1]
    found = sampled_poles(gains, T, delay=delay, integral=integral)
    M = closed_loop(gains, T, delay, integral, chain)
    assert same_polynomial(M, np.array(found.poles_z), 1e-9)
    assert len(found.poles) == chain + 1 + delay
    assert found.stable


@pytest.mark.parametrize("p", [20.0, 40.0])
def test_a_triple_pole_is_three_different_poles_at_one_kilohertz(p):
    found = sampled_poles([p**3, 3 * p**2, 3 * p], 1e-3)
    apart = np.abs(np.array(found.poles) + p)
    assert 0.1 * p < apart.max() < 0.6 * p  # the sample time splits it by its third root
    plant = delayed_hold(control.ss([[0, 1], [0, 0]], [[0], [1]], np.eye(2), 0), 1e-3)
    controller = control.ss(1.0, [[1e-3, 0.0]], p**3, [[3 * p**2, 3 * p]], 1e-3)
    L = controller * plant
    assert same_polynomial(L.A - L.B @ L.C, np.array(found.poles_z), 1e-9)


@pytest.mark.parametrize("integral", ["forward", "backward", "trapezoidal"])
@pytest.mark.parametrize("delay", [0, 1, 3])
@pytest.mark.parametrize("poles", [[-20.0] * 3, [-40.0] * 3, [-10.0, -20 + 5j, -20 - 5j], [-30.0, -30.0, -5.0]])
def test_gains_put_the_sampled_poles_where_they_were_asked(poles, delay, integral):
    T = 1e-3
    found = sampled_gains(poles, T, delay=delay, integral=integral)
    M = closed_loop(np.array(found.gains), T, delay, integral)
    # in δ = (z - 1)/T, so that three poles near z = 1 are told apart
    polynomial = np.poly((M - np.eye(len(M))) / T)
    asked = np.real(np.poly(np.expm1(np.array(poles) * T) / T))
    rest = np.polydiv(polynomial, asked)[1][-3:]
    size = 40.0 ** np.arange(len(rest) - 1, -1, -1)
    assert np.abs(rest * size).max() < 1e-8 * np.abs(polynomial[-1]) * 10
    assert found.stable


def test_the_sampled_gains_tend_to_the_continuous_ones():
    continuous = np.array([8000.0, 1200.0, 60.0])
    errors = [np.abs(np.array(sampled_gains([-20.0] * 3, T).gains) / continuous - 1).max() for T in (1e-3, 1e-4)]
    assert errors[1] == pytest.approx(errors[0] / 10, rel=0.05)  # first order in T


def test_gains_with_which_the_delay_adds_an_unstable_pole_are_refused():
    with pytest.raises(ParameterError, match="the delay adds others at z = .* not stable.*Ask for slower poles"):
        sampled_gains([-2000.0] * 3, 1e-3, delay=2)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: sampled_gains([-20, -20, 20], 1e-3), "expected poles in the left half plane"),
        (lambda: sampled_gains([-20, -20 + 1j, -20], 1e-3), "conjugate pairs"),
        (lambda: sampled_poles([1.0, 2.0, 3.0], 0.0), "expected two gains or more, a positive sample time"),
        (lambda: sampled_poles([1.0, 2.0, 3.0], 1e-3, integral="euler"), "expected 'forward', 'backward'"),
        (lambda: sampled_poles([1.0, 2.0, 3.0], 1e-3, delay=0.5), "a whole number"),
    ],
)
def test_a_sampled_design_that_makes_no_sense_is_refused(call, message):
    with pytest.raises(ParameterError, match=message):
        call()


@pytest.mark.parametrize(
    ("A", "poles", "where"),
    [(np.full((2, 2), np.nan), [-1.0, -2.0], "place.A"), (np.eye(2), [-1.0, np.nan], "place.poles")],
)
def test_nan_is_refused_where_it_stands(A, poles, where):
    with pytest.raises(ParameterError, match=f"{where}: found NaN"):
        place(A, [[1.0], [0.5]], poles)


def test_sampled_gains_refuse_nan_and_say_which_poles_a_delay_adds():
    with pytest.raises(ParameterError, match="expected poles in the left half plane"):
        sampled_gains([np.nan] * 3, 1e-3)
    with pytest.raises(ParameterError, match="the delay adds others"):
        sampled_gains([-1000.0] * 3, 1e-3, delay=2)


@pytest.mark.parametrize(
    ("A", "B", "gain"),
    [
        (np.diag([-1.0, -2.0]), [[1.0], [1e-10]], 2e10),  # −2 is reached by 1e-10 only: K₂ = (−3 + 2)(−4 + 2) / 1e-10
        (np.diag([-1.0, -2.0, -3.0]), [[1.0, 0.0], [1e-9, 0.0], [0.0, 1.0]], None),
        (np.diag([-1.0, -1.0 - 1e-9]), [[1.0], [1.0]], None),  # two modes that one input can't tell apart
    ],
)
def test_a_pair_that_is_hardly_controllable_is_refused_with_the_mode_and_the_gain(A, B, gain):
    wanted = -3.0 - np.arange(len(A))
    with pytest.raises(
        ParameterError, match=r"the inputs hardly reach a mode at -[12].* accept these gains with place"
    ) as e:
        place(A, B, wanted)
    if gain is not None:
        assert f"found gains up to {gain:.3g}: " in str(e.value)
        K = place(A, B, wanted, reach=0)
        assert np.max(np.abs(K)) == pytest.approx(gain, rel=1e-6)
        assert same_polynomial(A - np.array(B) @ K, wanted)


def test_fast_modes_beside_slow_ones_are_not_hardly_controllable():
    A, B = np.array([[0.0, 1, 0], [0, 0, 1], [0, -1e6, -1e3]]), np.array([[0.0], [0], [1e3]])
    assert same_polynomial(A - B @ place(A, B, [-10.0, -20, -30]), [-10.0, -20, -30], 1e-6)
