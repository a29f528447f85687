"""Arc length of a path: the integral of its speed as piecewise polynomials (NumPy only)."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.polynomial import chebyshev, polynomial

_DEGREE = 12  # of the polynomials that are fitted to the speed


@lru_cache(maxsize=1)
def _fit_matrices() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return nodes in [0, 1], and the matrices values → Chebyshev coefficients → powers of the integral from 0."""
    x = chebyshev.chebpts1(_DEGREE + 1)
    analysis = np.linalg.inv(chebyshev.chebvander(x, _DEGREE))
    integrals = np.zeros((_DEGREE + 2, _DEGREE + 1))
    for k in range(_DEGREE + 1):
        powers: np.ndarray = np.zeros(1)
        for c in chebyshev.cheb2poly(np.eye(_DEGREE + 1)[k])[::-1]:  # T_k(2 v − 1) in powers of v, exact in float64
            powers = polynomial.polyadd(polynomial.polymul(powers, [-1.0, 2.0]), [c])
        powers = polynomial.polyint(powers)[: k + 2]
        integrals[: len(powers), k] = powers
    return (x + 1.0) / 2.0, analysis, integrals


def integrate(speed: Callable[[np.ndarray], np.ndarray], knots: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return breaks, coefficients (pieces, 1, powers) and total of the integral of ``speed`` from the first knot on."""
    # intervals are halved until the Chebyshev coefficients of the speed on each have decayed to rounding errors
    nodes, analysis, integrals = _fit_matrices()
    start, width = np.asarray(knots[:-1], dtype=float), np.diff(knots)
    done: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    scale = None
    for level in range(60):
        values = speed((start[:, None] + width[:, None] * nodes).ravel()).reshape(len(start), -1)
        fitted = values @ analysis.T
        if scale is None:
            scale = float(np.sum(width * fitted[:, 0]))
        tail = np.max(np.abs(fitted[:, -2:]), axis=1)
        accept = (tail <= 1e-15 * np.max(values, axis=1)) | (width * tail <= 2e-17 * scale) | (level == 59)
        done.append((start[accept], width[accept], fitted[accept]))
        start, width = start[~accept], width[~accept] / 2.0
        if not len(start):
            break
        start, width = np.concatenate([start, start + width]), np.concatenate([width, width])
    starts, widths, fits = (np.concatenate([d[i] for d in done]) for i in range(3))
    order = np.argsort(starts, kind="stable")
    starts, widths, fits = starts[order], widths[order], fits[order]
    k = np.arange(0, _DEGREE + 1, 2)
    areas = widths * (fits[:, k] @ (1.0 / (1.0 - k**2)))  # ∫ T_k over [−1, 1] is 2 / (1 − k²) for even k
    ends = np.concatenate([[0.0], np.cumsum(areas)])
    coefficients = (fits @ integrals.T) * widths[:, None] ** (1.0 - np.arange(_DEGREE + 2))
    coefficients[:, 0] = ends[:-1]
    return np.append(starts, knots[-1]), coefficients[:, None, :], float(ends[-1])
