"""Transfer functions with one channel as state spaces, without loss of digits near z = 1."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

SHORT = 32
"""Binary digits up to which a coefficient is taken as exact."""


class CompanionForm(NamedTuple):
    """State space p x = A x + B u, y = C x + D u, with p = s, or p = z − 1 of a sampled system."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray


def realize(numerator: Sequence[float], denominator: Sequence[float], *, sampled: bool) -> CompanionForm | None:
    """Return the scaled companion form of a transfer function; None where it is improper or not finite.

    The coefficients are polynomials in s or z, the highest power first. Those in z become polynomials in z − 1 in exact
    arithmetic: m poles at z = 1, which a companion form in z scatters by the m-th root of the rounding, stay where they
    are.
    """
    if not all(np.all(np.isfinite(c)) for c in (numerator, denominator)):
        return None
    over, under = _exact(numerator), _exact(denominator)
    if sampled:
        over, under = _shift(over), _shift(under)
    n = len(under) - 1
    if n < 0 or len(over) > n + 1:
        return None
    monic = [c / under[-1] for c in under[:n]]
    scaled = [c / under[-1] for c in over] + [Fraction(0)] * (n + 1 - len(over))
    through = scaled[n]
    rest = [c - through * a for c, a in zip(scaled[:n], monic, strict=True)]
    sigma = _power_of_two([float(abs(c)) ** (1.0 / (n - k)) for row in (monic, rest) for k, c in enumerate(row)])
    A, B, C = np.diag(np.full(max(n - 1, 0), float(sigma)), 1) if n else np.zeros((0, 0)), np.zeros((n, 1)), []
    for k, (a, c) in enumerate(zip(monic, rest, strict=True)):
        A[n - 1, k] = float(-a * sigma ** (1 - n + k))
        C.append(float(c * sigma ** (k - n)))
    if n:
        B[n - 1, 0] = float(sigma)
    return CompanionForm(A, B, np.array(C).reshape(1, n), np.array([[float(through)]]))


class Coefficients(NamedTuple):
    """Coefficients of a transfer function in z, the highest power first, each rounded to a floating-point number."""

    numerator: tuple[float, ...]
    denominator: tuple[float, ...]

    def error(self, z: complex) -> float:
        """Return the relative error at a point that the rounding of the coefficients makes.

        Those of few digits, such as 1, −3, 3, −1, are taken as exact.
        """
        found = 0.0
        for row in self:
            inexact = sum(abs(c) for c in row if not (np.frexp(c)[0] * 2.0**SHORT).is_integer())
            found += 0.5 * float(np.finfo(float).eps) * inexact / (abs(complex(np.polyval(row, z))) + 1e-300)
        return found


def _exact(coefficients: Sequence[float]) -> list[Fraction]:
    """Return coefficients as fractions, the lowest power first, without leading zeros."""
    found = [Fraction(float(c)) for c in reversed(list(coefficients))]
    while found and found[-1] == 0:
        found.pop()
    return found


def _shift(coefficients: list[Fraction]) -> list[Fraction]:
    """Return the coefficients over p = z − 1 of a polynomial in z, the lowest power first, by Horner's scheme."""
    found = list(coefficients)
    for start in range(len(found)):
        for k in range(len(found) - 2, start - 1, -1):
            found[k] += found[k + 1]
    return found


def _power_of_two(sizes: Sequence[float]) -> Fraction:
    """Return the power of two next to the largest size; 1 where all are zero."""
    size = max(sizes, default=0.0)
    return Fraction(2) ** round(float(np.log2(size))) if 0.0 < size < np.inf else Fraction(1)
