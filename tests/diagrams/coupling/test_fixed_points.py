"""Values that a function returns unchanged: by Newton's method from far away, and along a curve."""

import numpy as np
import pytest

from loopwright.diagrams.coupling import find_fixed_point


def zero_of(g):
    """The function whose fixed points are the zeros of another one."""
    return lambda y: y - g(y)


BROWN = zero_of(lambda y: np.array([*(y[:-1] + y.sum() - len(y) - 1.0), np.prod(y) - 1.0]))
SOLVED = {
    "linear": (lambda y: 1.0 + 0.999 * y, [0.0], [1000.0]),
    "steep": (lambda y: 1.0 - 1e5 * y, [1.0], [1.0 / 100001.0]),
    "far, where whole steps grow": (zero_of(lambda y: np.arctan(y - 1.0)), [50.0], [1.0]),
    "behind a least residual": (zero_of(lambda y: y**3 - 2.0 * y + 2.0), [1.0], [-1.7692923542386314]),
    "steps in a circle": (zero_of(lambda y: y**3 - 2.0 * y + 2.0), [0.0], [-1.7692923542386314]),
    "zero": (lambda y: np.array([0.5 * y[1], 0.3 * y[0] - 0.2 * y[1]]), [1.0, 1.0], [0.0, 0.0]),
    "valley": (zero_of(lambda y: np.array([10.0 * (y[1] - y[0] ** 2), 1.0 - y[0]])), [-1.2, 1.0], [1.0, 1.0]),
    "almost linear": (BROWN, [0.5] * 5, [1.0] * 5),
}


@pytest.mark.parametrize("case", SOLVED)
def test_a_solution_is_found_to_rounding(case):
    function, guess, expected = SOLVED[case]
    found = find_fixed_point(function, np.array(guess))
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)


def test_a_function_without_values_around_is_searched_where_it_has_some():
    """y = √(y − 0.2) + 0.1 y has no value below 0.2; 0.81 y² − y + 0.2 = 0."""
    with np.errstate(invalid="ignore"):
        found = find_fixed_point(lambda y: np.sqrt(y - 0.2) + 0.1 * y, np.array([3.0]))
    assert min(abs(found - np.roots([0.81, -1.0, 0.2]))) < 1e-12


@pytest.mark.parametrize(
    "function",
    [lambda y: y + 1.0, lambda y: y + 1.0 + y * y, lambda y: np.full(1, np.nan)],
    ids=["parallel", "above", "undefined"],
)
def test_no_solution_is_none(function):
    count = []
    assert find_fixed_point(lambda y: count.append(1) or function(y), np.zeros(1), most=400) is None
    assert len(count) <= 400
