"""Transfer functions with one channel as state spaces, without loss of digits near z = 1."""

from __future__ import annotations

import math
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


def realize(
    numerator: Sequence[float | Fraction], denominator: Sequence[float | Fraction], *, sampled: bool
) -> CompanionForm | None:
    """Return the scaled companion form of a transfer function; None where it is improper or not finite.

    The coefficients are polynomials in s or z, the highest power first. Those in z become polynomials in z − 1 in exact
    arithmetic: m poles at z = 1, which a companion form in z scatters by the m-th root of the rounding, stay where they
    are. Poles at z = 0, such as those of a delay, are a chain of delays by one sample, for the same reason.
    """
    if not all(math.isfinite(c) for c in (*numerator, *denominator)):
        return None
    over, under = _exact(numerator), _exact(denominator)
    if not under or len(over) > len(under):
        return None
    if not sampled:
        return _companion([over], under)
    delays = next(k for k, c in enumerate(under) if c)
    under = under[delays:]
    # with w = u/D: the powers of z from that of the denominator's z^m on act on w, the others on delayed w
    form = _companion([_shift(over[delays:]), [Fraction(1)]], _shift(under))
    early = [*over[:delays], *[Fraction(0)] * (delays - len(over))]
    return _with_delays(form, [float(c) for c in reversed(early)])


def _with_delays(form: CompanionForm, taps: Sequence[float]) -> CompanionForm:
    """Return a form with the outputs (y, w) with delays of w by 1, 2, … samples added to y, each times its tap."""
    (n, m), rows = (len(form.A), len(taps)), (form.C, form.D)
    (C, c), (D, d) = ((row[:1], row[1:]) for row in rows)
    if not m:
        return CompanionForm(form.A, form.B, C, D)
    first = np.eye(m, 1)
    A = np.block([[form.A, np.zeros((n, m))], [first @ c, np.eye(m, k=-1) - np.eye(m)]])
    return CompanionForm(A, np.vstack([form.B, first @ d]), np.hstack([C, np.reshape(taps, (1, m))]), D)


def _companion(overs: Sequence[list[Fraction]], under: list[Fraction]) -> CompanionForm:
    """Return the companion form of numerators over one denominator, polynomials with the lowest power first."""
    n = len(under) - 1
    monic = [c / under[-1] for c in under[:n]]
    scaled = [[c / under[-1] for c in over] + [Fraction(0)] * (n + 1 - len(over)) for over in overs]
    through = [row[n] for row in scaled]
    rest = [[c - d * a for c, a in zip(row[:n], monic, strict=True)] for row, d in zip(scaled, through, strict=True)]
    sigma = _power_of_two([float(abs(c)) ** (1.0 / (n - k)) for row in (monic, rest[0]) for k, c in enumerate(row)])
    A, B = np.diag(np.full(max(n - 1, 0), float(sigma)), 1) if n else np.zeros((0, 0)), np.zeros((n, 1))
    for k, a in enumerate(monic):
        A[n - 1, k] = float(-a * sigma ** (1 - n + k))
    if n:
        B[n - 1, 0] = float(sigma)
    C = np.array([[float(c * sigma ** (k - n)) for k, c in enumerate(row)] for row in rest]).reshape(len(overs), n)
    return CompanionForm(A, B, C, np.array([[float(d)] for d in through]))


def read_companion(
    A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray
) -> tuple[list[Fraction], list[Fraction]] | None:
    """Return the polynomials in z of a state space in companion form, the highest power first; None of another one.

    One of A's outer rows, or columns, has the coefficients of the denominator, and the others shift the states. They
    are read without rounding: of integrators that are sampled fast, all states are nearly equal, and an equation with
    z I − A has no digits left near z = 1.
    """
    n = len(A)
    if n < 2 or not all(np.isfinite(M).all() for M in (A, B, C, D)):
        return None
    for one, into, out in ((A, B[:, 0], C[0]), (A.T, C[0], B[:, 0])):
        for turn in (slice(None), slice(None, None, -1)):
            M, b, c = one[turn, turn], into[turn], out[turn]
            if np.array_equal(M[1:], np.eye(n - 1, n)) and b[0] != 0.0 and not b[1:].any():
                gain, through = Fraction(float(b[0])), Fraction(float(D[0, 0]))
                under = [Fraction(1), *(-Fraction(float(a)) for a in M[0])]
                over = [Fraction(0), *(gain * Fraction(float(v)) for v in c)]
                return [v + through * a for v, a in zip(over, under, strict=True)], under
    return None


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


def _exact(coefficients: Sequence[float | Fraction]) -> list[Fraction]:
    """Return coefficients as fractions, the lowest power first, without leading zeros."""
    found = [c if isinstance(c, Fraction) else Fraction(float(c)) for c in reversed(list(coefficients))]
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
