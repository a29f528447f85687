"""Root finding in an interval."""

from __future__ import annotations

from collections.abc import Callable


def find_root(f: Callable[[float], float], a: float, fa: float, b: float, fb: float, resolution: float) -> float:
    """Return an instant at or just behind a root of ``f``, on the side of b: a root is within ``resolution`` before it.

    Inverse quadratic interpolation where it is safe, else bisection (T. R. Chandrupatla, Advances in Engineering
    Software 28 (1997), 145-149), from a first step of the secant. No object that is made here refers to itself: a cycle
    at each event would have Python collect garbage all the time.

    Parameters
    ----------
    f : callable
        The function.
    a, b : float
        The ends of the interval.
    fa, fb : float
        Values of f there, of different sign; that at b may be 0.
    resolution : float
        Length of the interval in which the root is known in the end, of a few ulps at least.
    """
    if abs(b - a) <= resolution:
        return b  # a step within it could lead out of the interval
    up = fa < 0.0  # whether f is positive behind the root
    part = fa / (fa - fb)  # of the way from end 1 to end 2
    x1, f1, x2, f2 = a, fa, b, fb  # the last value, and the other end of the interval around the root
    least = 0.5 * resolution / abs(b - a)
    while True:
        part = min(max(part, least), 1.0 - least)
        x = x1 + part * (x2 - x1)
        fx = f(x)
        if (fx >= 0.0 if up else fx <= 0.0) == (f1 >= 0.0 if up else f1 <= 0.0):
            x3, f3 = x1, f1
        else:
            x3, f3, x2, f2 = x2, f2, x1, f1
        x1, f1 = x, fx
        least = 0.5 * resolution / abs(x2 - x1)
        if least >= 0.5:
            return x1 if (f1 >= 0.0 if up else f1 <= 0.0) else x2
        xi, phi = (x1 - x2) / (x3 - x2), (f1 - f2) / (f3 - f2) if f3 != f2 else 2.0
        if phi * phi < xi and (1.0 - phi) ** 2 < 1.0 - xi:
            part = f1 / (f2 - f1) * f3 / (f2 - f3) + (x3 - x1) / (x2 - x1) * f1 / (f3 - f1) * f2 / (f3 - f2)
        else:
            part = 0.5
