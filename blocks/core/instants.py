"""Periodic instants, and comparisons of instants that allow for their rounding."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np

from .values import Array

FINEST = Fraction(1, 10**9)
"""Times that are multiples of it, 1 ns, are read as decimal numbers."""
_LARGEST_DENOMINATOR = 10**6
_TOLERANCE = 4.0 * float(np.finfo(float).eps)  # of t: t, the period and their ratio are rounded once each


def left_of(t: float) -> float:
    """Return a time just before t, at which an edge at t has not come yet for `period_of` with its tolerance."""
    # a solver takes left limits at t there; the floating-point number before t would be too near
    return t - 4.0 * _TOLERANCE * abs(t)


def right_of(t: float) -> float:
    """Return a time just after t, as far from it as `left_of` is."""
    return t + 4.0 * _TOLERANCE * abs(t)


def is_before(a: float, b: float) -> bool:
    """Whether a comes before b by more than the rounding of both; nearer than that they are one instant."""
    return a < b - 2.0 * _TOLERANCE * abs(b) if b < math.inf else a < b


def move_earlier(instants: Array) -> Array:
    """Return the first times that count as the given instants: 2e-15 t earlier, which allows for their rounding."""
    # three times 0.1 is more than the tick at 0.3, and so may a time of np.linspace be; both mean the tick
    return instants - 2.0 * _TOLERANCE * np.abs(instants)


def period_of(t: Array, period: Array, delay: Array) -> tuple[Array, Array, Array]:
    """Return the number of the period at t, the time since it began in periods, and the rounding of that time."""
    passed = (t - delay) / period
    tolerance = _TOLERANCE * (np.abs(t) + np.abs(delay)) / period
    number = np.floor(passed + tolerance)
    return number, passed - number, tolerance


def read_time(value: float) -> Fraction | None:
    """Return the exact seconds that a floating-point number means; None where that is open, as for 0.1 + 0.2.

    A number that is a multiple of 1 ns is that decimal number: 0.0007 is 7/10000. Else it is p/q with q up to 10⁶, if
    that is the number when it is rounded: 1/3, 1/44100.
    """
    decimal = Fraction(repr(float(value)))
    if (decimal / FINEST).denominator == 1:
        return decimal
    found = Fraction(float(value)).limit_denominator(_LARGEST_DENOMINATOR)
    return found if float(found) == float(value) else None


def exact_number(value: float) -> Fraction:
    """Return the fraction that `read_time` gives, else that of the number's decimal digits."""
    return read_time(value) or Fraction(repr(float(value)))


def next_edge(t: float, period: float, *offsets: float) -> float:
    """Return the first time after t that is one of the offsets plus k ≥ 0 periods, all of them exact."""
    exact = exact_number(period)
    best = math.inf
    for offset in offsets:
        first = exact_number(offset)
        k = max(math.floor((Fraction(t) - first) / exact), 0)
        while float(first + k * exact) <= t:
            k += 1
        best = min(best, float(first + k * exact))
    return best
