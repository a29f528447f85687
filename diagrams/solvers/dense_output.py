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


class FromStart:
    """The polynomial x(t₀ + u h) = x₀ + Σ cₖ uᵏ over a step.

    Parameters
    ----------
    t : float
        Start t₀ of the step in s.
    x : ndarray, shape (n,)
        State x₀ there.
    h : float
        Length of the step in s.
    coefficients : ndarray, shape (q, n)
        c₁ to c_q.
    """

    def __init__(self, t: float, x: np.ndarray, h: float, coefficients: np.ndarray):
        self._t, self._x, self._h, self._coefficients = t, x, h, coefficients[::-1].copy()

    def __call__(self, t: float) -> np.ndarray:
        """Return the state at a time within the step."""
        u = (t - self._t) / self._h
        change = np.zeros_like(self._x)
        for c in self._coefficients:
            change = (change + c) * u
        return np.asarray(self._x + change)

    def many(self, times: np.ndarray) -> np.ndarray:
        """Return the states at several times, one row each."""
        u = ((times - self._t) / self._h)[:, None]
        change = np.zeros((len(times), len(self._x)))
        for c in self._coefficients:
            change = (change + c) * u
        return np.asarray(self._x + change)

    def polynomial(self) -> Polynomial:
        """Return it; see `AcceptedStep.polynomial`."""
        return Polynomial(self._t, self._h, self._x, self._coefficients[::-1].T)


class OneStepDense:
    """Dense output of one of SciPy's one-step methods, with less work per call and to the last bit its value."""

    def __init__(self, dense: Any, method: str):
        self._dense, self._powers = dense, method in ("RK23", "RK45", "Radau")
        if self._powers:
            self._scale = 1.0 if method == "Radau" else dense.h
            self._u = np.empty(dense.order + 1)

    def __call__(self, t: float) -> np.ndarray:
        """Return the state at a time within the step."""
        dense = self._dense
        if not self._powers:
            return np.asarray(dense(t))
        u = power = (t - dense.t_old) / dense.h
        powers = self._u
        powers[0] = u
        for k in range(1, len(powers)):
            power *= u
            powers[k] = power
        found: np.ndarray = np.dot(dense.Q, powers)
        found *= self._scale
        found += dense.y_old
        return found

    def many(self, times: np.ndarray) -> np.ndarray:
        """Return the states at several times, one row each; to rounding those of single calls."""
        dense = self._dense
        if not self._powers:
            return np.asarray(dense(times).T)
        u = (times - dense.t_old) / dense.h
        powers = np.multiply.accumulate(np.broadcast_to(u, (dense.order + 1, len(u))))
        found: np.ndarray = powers.T @ (self._scale * dense.Q.T)
        found += dense.y_old
        return found

    def polynomial(self) -> Polynomial | None:
        """Return it, but for DOP853; see `AcceptedStep.polynomial`."""
        dense = self._dense
        return Polynomial(dense.t_old, dense.h, dense.y_old, self._scale * dense.Q) if self._powers else None


def from_nordsieck(dense: Any, t_old: float, x_old: np.ndarray) -> FromStart:
    """Return LSODA's dense output: Σ yⱼ sʲ with s = (t − t₁)/h₁, expanded about the start of the step."""
    h, start, terms = dense.t - t_old, (t_old - dense.t) / dense.h, dense.yh
    ratio, q = h / dense.h, terms.shape[1] - 1
    coefficients = [
        sum(terms[:, j] * (comb(j, k) * start ** (j - k)) for j in range(k, q + 1)) * ratio**k for k in range(1, q + 1)
    ]
    return FromStart(t_old, x_old, h, np.array(coefficients))


def from_differences(dense: Any, t_old: float, x_old: np.ndarray) -> FromStart:
    """Return the dense output of SciPy's BDF: Newton's polynomial through backward differences, about the start."""
    h, q = dense.t - t_old, len(dense.denom)
    coefficients, product = np.zeros((q, len(x_old))), [1.0]
    starts, widths = ((t_old - dense.t_shift) / dense.denom).tolist(), (h / dense.denom).tolist()
    for j, (a, b) in enumerate(zip(starts, widths, strict=True)):  # one more factor, a + b u, in each term
        product = [a * c + b * before for c, before in zip([*product, 0.0], [0.0, *product], strict=True)]
        coefficients[: j + 1] += np.multiply.outer(product[1:], dense.D[j + 1])
    return FromStart(t_old, x_old, h, coefficients)


def from_derivatives(t_old: float, x_old: np.ndarray, h: float, derivatives: np.ndarray) -> FromStart:
    """Return the Taylor polynomial of a dense output whose derivatives at the start are known, shape (q, n)."""
    q = len(derivatives)
    scale = np.array([h**k / factorial(k) for k in range(1, q + 1)])
    return FromStart(t_old, x_old, h, scale[:, None] * derivatives)
