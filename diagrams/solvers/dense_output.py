"""Dense output of SciPy's and SUNDIALS' methods: polynomials from the start of a step.

A multistep method keeps a polynomial about the end of a step. Near the start its value is the state there plus rounding
errors of the terms, a few ulps, which can carry an indicator that has just crossed zero back across it: an event that
isn't there. Expanded about the start, x(t₀ + u h) = x₀ + Σ cₖ uᵏ with k ≥ 1, the terms vanish with u, and so do their
errors.
"""

from __future__ import annotations

from math import comb, factorial
from typing import Any

import numpy as np

from .base import Polynomial


def from_nordsieck(dense: Any, t_old: float, x_old: np.ndarray) -> Polynomial:
    """Return LSODA's dense output: Σ yⱼ sʲ with s = (t − t₁)/h₁, expanded about the start of the step."""
    h, start, terms = dense.t - t_old, (t_old - dense.t) / dense.h, dense.yh
    ratio, q = h / dense.h, terms.shape[1] - 1
    coefficients = [
        sum(terms[:, j] * (comb(j, k) * start ** (j - k)) for j in range(k, q + 1)) * ratio**k for k in range(1, q + 1)
    ]
    return Polynomial(t_old, h, x_old, np.array(coefficients))


def from_differences(dense: Any, t_old: float, x_old: np.ndarray) -> Polynomial:
    """Return the dense output of SciPy's BDF: Newton's polynomial through backward differences, about the start."""
    h, q = dense.t - t_old, len(dense.denom)
    coefficients, product = np.zeros((q, len(x_old))), [1.0]
    starts, widths = ((t_old - dense.t_shift) / dense.denom).tolist(), (h / dense.denom).tolist()
    for j, (a, b) in enumerate(zip(starts, widths, strict=True)):  # one more factor, a + b u, in each term
        product = [a * c + b * before for c, before in zip([*product, 0.0], [0.0, *product], strict=True)]
        coefficients[: j + 1] += np.multiply.outer(product[1:], dense.D[j + 1])
    return Polynomial(t_old, h, x_old, coefficients)


def from_derivatives(t_old: float, x_old: np.ndarray, h: float, derivatives: np.ndarray) -> Polynomial:
    """Return the Taylor polynomial of a dense output whose derivatives at the start are known, shape (q, n)."""
    q = len(derivatives)
    scale = np.array([h**k / factorial(k) for k in range(1, q + 1)])
    return Polynomial(t_old, h, x_old, scale[:, None] * derivatives)
