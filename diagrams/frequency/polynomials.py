"""Arithmetic of polynomials in s and z, for pole placement."""

from __future__ import annotations

from math import factorial
from typing import Literal

import numpy as np

from ...blocks.core import ParameterError

Integral = Literal["forward", "backward", "trapezoidal"]
AGREE = 1e-6
"""Largest difference of characteristic polynomials that agree, relative to the largest scaled coefficient."""


def real_polynomial(poles: np.ndarray) -> np.ndarray:
    """Return the coefficients of the polynomial with these roots, multiplied out pairwise so that they are real."""
    c = np.poly(poles)
    size = np.poly(-np.abs(poles))
    if np.any(np.abs(np.imag(c)) > 1e-9 * np.abs(size) + 1e-300):
        raise ParameterError(
            f"found the poles {list(poles)!r}; expected complex ones in conjugate pairs. Add the missing conjugates.",
            block="place",
            port="poles",
        )
    return np.asarray(np.real(c))


def relative_difference(found: np.ndarray, wanted: np.ndarray, size: float = 0.0) -> float:
    """Return the largest difference of two monic polynomials' coefficients, relative to the largest wanted one.

    Time is scaled by the size of the wanted roots, or by ``size`` where all of them are zero.
    """
    n = len(wanted) - 1
    roots = float(np.max(np.abs(wanted[1:]) ** (1 / np.arange(1, n + 1)), initial=0.0))
    scale = (roots or size or 1.0) ** np.arange(n + 1)
    return float(np.max(np.abs(found - wanted) / scale) / np.max(np.abs(wanted) / scale))


def remainder(polynomial: np.ndarray, divisor: np.ndarray, size: float) -> np.ndarray:
    """Return the remainder of a division of polynomials in w, computed in w/size to keep its digits."""
    scaled = polynomial * size ** np.arange(len(polynomial) - 1, -1, -1.0)
    by = divisor * size ** np.arange(len(divisor) - 1, -1, -1.0)
    return divide(np.append(np.zeros(max(0, len(by) - len(scaled))), scaled), by)[1]


def divide(polynomial: np.ndarray, divisor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return quotient and remainder; the remainder has one coefficient for each root of the divisor."""
    rest, steps = np.array(polynomial, dtype=float), len(polynomial) - len(divisor) + 1
    quotient = np.zeros(steps)
    for k in range(steps):
        quotient[k] = rest[k] / divisor[0]
        rest[k : k + len(divisor)] -= quotient[k] * divisor
    return quotient, rest[steps:]


def eulerian_polynomial(k: int, T: float) -> np.ndarray:
    """Return the Eulerian polynomial E_k(z)/k! in w, where z = 1 + T w."""
    eulerian = [1.0]
    for n in range(2, k + 1):
        longer = [0.0] * n
        for j in range(n):
            longer[j] = (j + 1) * (eulerian[j] if j < n - 1 else 0.0) + (n - j) * (eulerian[j - 1] if j else 0.0)
        eulerian = longer
    out: np.ndarray = np.zeros(1)
    for c in eulerian:
        out = np.polyadd(np.polymul(out, [T, 1.0]), [c])
    return np.asarray(np.trim_zeros(out, "f")) / factorial(k)
