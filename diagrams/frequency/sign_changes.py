"""Refinement of a sign change that a scan has found."""

from __future__ import annotations

from collections.abc import Callable


def refine_sign_change(
    function: Callable[[float], float], low: float, high: float, *, xtol: float, rtol: float = 1e-14
) -> float:
    """Return where a function changes its sign between two values, by Brent's method.

    A scan computes many values at once, which may round otherwise than one by one. An end at which the function is 0
    but for rounding can then have lost the sign that the scan saw; it is the place that is looked for.

    Parameters
    ----------
    function : callable
        From a number to a number.
    low, high : float
        Ends at which a scan saw different signs.
    xtol, rtol : float
        Absolute and relative tolerance of the result.
    """
    from scipy.optimize import brentq

    first, last = function(low), function(high)
    if (first < 0.0) == (last < 0.0):
        return low if abs(first) <= abs(last) else high
    return float(brentq(function, low, high, xtol=xtol, rtol=rtol, maxiter=200))
