"""Choices among numbers that are equal but for rounding."""

import control
import numpy as np
import pytest

from loopwright.diagrams.frequency import first_largest, order_key, refine_sign_change
from loopwright.diagrams.linearization.trim_search import _make_basis
from loopwright.frequency import disk_margin


@pytest.mark.parametrize("seed", range(5))
def test_the_first_of_equal_numbers_is_chosen_whatever_rounding_makes_of_them(seed):
    rng = np.random.default_rng(seed)
    values = np.array([1.0, 3.0, 3.0, 2.9999, np.nan, 3.0]) * (1 + 1e-13 * rng.uniform(-1, 1, 6))
    assert first_largest(values) == 1
    assert first_largest([-2.0, -2.0 * (1 - 1e-13)]) == 0
    assert order_key(values[1]) == order_key(values[2]) == 3.0


@pytest.mark.parametrize("seed", range(5))
def test_the_basis_of_a_space_does_not_depend_on_how_singular_vectors_are_turned(seed):
    rng = np.random.default_rng(seed)
    space = np.array([[1.0, 2.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0, -1.0]])
    rows = np.linalg.qr(space.T)[0].T
    turn = np.linalg.qr(rng.normal(size=(2, 2)))[0]
    expected = [[0.0, 0.0, 1.0, 1.0, -1.0], [0.5, 1.0, 0.0, 0.0, 0.0]]
    found = _make_basis(turn @ rows)
    found = found[np.argsort(found[:, 0])]
    np.testing.assert_allclose(found, expected, atol=1e-13)


def test_a_root_at_an_end_that_has_lost_its_sign_is_that_end():
    def line(x):
        return x - 2.0

    assert refine_sign_change(line, 1.0, 5.0, xtol=1e-14) == pytest.approx(2.0, abs=1e-13)
    assert refine_sign_change(line, 2.0 + 1e-15, 5.0, xtol=1e-14) == 2.0 + 1e-15
    assert refine_sign_change(line, 1.0, 2.0 - 1e-15, xtol=1e-14) == 2.0 - 1e-15
    assert refine_sign_change(line, 2.0, 5.0, xtol=1e-14) == 2.0


@pytest.mark.parametrize("seed", range(4))
def test_of_equal_peaks_a_disk_margin_has_the_one_at_the_lowest_frequency(seed):
    """Two channels of one loop 200/(s (s + 20)), the other twice as fast: the same peak at w and at 2 w."""
    rng = np.random.default_rng(seed)
    single = control.ss(control.tf([200.0], [1.0, 20.0, 0.0]))
    alone = disk_margin(single)
    turn = np.linalg.qr(rng.normal(size=(2, 2)))[0]
    A = np.block([[single.A, np.zeros((2, 2))], [np.zeros((2, 2)), 2.0 * single.A]])
    B = np.block([[single.B, np.zeros((2, 1))], [np.zeros((2, 1)), 2.0 * single.B]])
    C = np.block([[single.C, np.zeros((1, 2))], [np.zeros((1, 2)), single.C]])
    found = disk_margin(control.ss(A, B @ turn.T, turn @ C, np.zeros((2, 2))))
    assert float(found.alpha) == pytest.approx(float(alone.alpha), rel=1e-8)
    assert float(found.frequency) == pytest.approx(float(alone.frequency), rel=1e-3)
