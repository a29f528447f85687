"""Derivatives that are held against differences of the values."""

import numpy as np
import pytest

from loopwright.fmus import FmuError
from loopwright.fmus.fmu_block.slope_check import check_slopes


def check(function, J, at, nominal=1.0, limits=(-np.inf, np.inf)):
    J, at = np.atleast_2d(np.asarray(J, dtype=float)), np.atleast_1d(np.asarray(at, dtype=float))
    ends = tuple(np.full(at.size, end) for end in limits)
    moved = np.full(at.size, True)
    return check_slopes(J, lambda x: np.atleast_1d(function(x)), at, np.full(at.size, nominal), ends, moved)


def pendulum(x):
    return np.array([x[1], -9.81 * np.sin(x[0]) - 0.3 * x[1] * abs(x[1])])


def slope(x):
    return np.array([[0.0, 1.0], [-9.81 * np.cos(x[0]), -0.6 * abs(x[1])]])


@pytest.mark.parametrize("at", [[0.3, 0.2], [0.0, 0.0], [2.0, -3.0]])
def test_right_derivatives_agree_and_wrong_ones_are_found_to_the_entry(at):
    at = np.array(at)
    right = check(pendulum, slope(at), at)
    assert (right.gap, right.is_wrong) == (0.0, False)
    assert not right.error.any()
    for e in (1e-8, 1e-6) if at.any() else (1e-6,):  # at rest the friction has a second derivative that jumps
        J = slope(at)
        J[1, 0] *= 1.0 + e
        found = check(pendulum, J, at)
        assert not found.is_wrong
        assert found.gap == pytest.approx(e, rel=0.3)
        assert found.error[1, 0] == pytest.approx(e * abs(J[1, 0]), rel=0.3)
        assert np.count_nonzero(found.error) == 1
    J = slope(at)
    J[0, 1] = -1.0
    found = check(pendulum, J, at)
    assert found.is_wrong
    np.testing.assert_allclose(found.J, slope(at), atol=1e-8)


def test_at_a_kink_and_beside_one_either_slope_is_right():
    for J in (1.0, -1.0):
        assert check(np.abs, J, 0.0).gap == 0.0
    assert check(np.abs, 1.5, 0.0).is_wrong
    near = check(lambda x: np.abs(x - 1e-6), -1.0, 0.0)
    assert (near.gap, near.is_wrong) == (0.0, False)


@pytest.mark.parametrize(("function", "J", "distance"), [(np.abs, 0.0, 1.0), (lambda x: np.maximum(x, 0.0), 0.5, 0.5)])
def test_the_mean_of_the_slopes_to_both_sides_of_a_kink_is_kept_with_its_distance_to_them(function, J, distance):
    found = check(function, J, 0.0)
    assert not found.is_wrong
    assert found.J[0, 0] == J
    assert found.error[0, 0] == pytest.approx(distance)
    beside = check(lambda x: function(x - 1.0), J, 1.0)  # rounding makes one side or the other the nearer one
    assert beside.error[0, 0] == pytest.approx(distance)


@pytest.mark.filterwarnings("error")
def test_slopes_of_a_cubic_at_its_saddle_divide_by_nothing():
    found = check(lambda x: np.array([-(x[0] ** 3) + x[1] ** 3]), [[0.0, 0.0]], [0.0, 0.0])
    assert (found.gap, found.is_wrong) == (0.0, False)


def test_stairs_refute_nothing_but_a_level_value_does():
    def single(x):
        return np.float64(np.float32(101325.0 + x[0]))  # steps of 0.0078

    found = check(single, 1.0, 0.7)
    assert not found.is_wrong
    assert np.isnan(found.gap)
    assert found.J[0, 0] == 1.0
    assert not check(lambda x: single(x) - 1e-3 * x, 0.999, 0.7).is_wrong  # a part of it is in double precision
    fine = check(lambda x: 1e12 * (1.0 + 1e-12 * x) - 1e12, 1.0, 0.5)
    assert (fine.is_wrong, fine.J[0, 0]) == (False, 1.0)
    assert check(lambda x: 2.0 * x, 1.9, 0.3).is_wrong
    level = check(lambda x: np.minimum(x, 0.5), 1.0, 0.7)
    assert level.is_wrong
    assert level.J[0, 0] == 0.0


def test_beside_a_limit_and_with_an_offset_differences_still_tell():
    def limited(x):
        assert np.all(x >= 0.0)
        return 1e5 + np.sqrt(1.0 + x)

    assert check(limited, 0.5, 0.0, limits=(0.0, np.inf)).gap == 0.0
    assert check(limited, 0.6, 0.0, limits=(0.0, np.inf)).is_wrong


def test_a_nominal_value_that_is_far_too_large_refutes_nothing():
    found = check(np.sin, 1.0, 0.0, nominal=1e9)
    assert not found.is_wrong
    assert np.isnan(found.gap)
    assert found.J[0, 0] == 1.0


def test_values_that_can_not_be_computed_beside_the_point_leave_the_derivatives_unknown():
    def refuse(x):
        if x[0] != 0.0:
            raise FmuError("no solution here")
        return x

    found = check(refuse, 1.0, 0.0)
    assert np.isnan(found.gap)
    assert not found.is_wrong
