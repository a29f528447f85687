"""Piecewise polynomials: evaluated by NumPy, or traced as a table that CasADi looks up.

A lookup can't be expanded to scalar operations: it stays a CasADi MX function, whose arithmetic on the coefficients is
one call of a scalar (SX) function.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from casadi import ArrayInterface

from ..core import Array, TraceError
from ..tracing import as_traced

__all__ = ["bilinear", "is_traced", "jet", "piecewise", "wrap"]


def is_traced(value: Any) -> bool:
    """Whether ``value`` is a symbol of a trace and not a number."""
    return isinstance(value, ArrayInterface)


def wrap(s: Array, start: float, period: float) -> tuple[Array, Array]:
    """Return the number of laps in ``s``, and the rest in [start, start + period]."""
    lap = np.floor((s - start) / period)
    return lap, s - lap * period


def piecewise(breaks: np.ndarray, coefficients: np.ndarray, s: Array) -> Array:
    """Evaluate K piecewise polynomials at s, a number, an array or a traced scalar: shape (K,), then that of s.

    f_k(s) = Σ_j coefficients[i, k, j] (s − breaks[i])^j in the piece i with breaks[i] ≤ s < breaks[i + 1]; beyond the
    first and the last break the end pieces are continued. Derivatives of a trace with respect to s are exact.
    """
    return jet(breaks, coefficients, s, 0)[0]


def jet(breaks: np.ndarray, coefficients: np.ndarray, s: Array, highest: int) -> tuple[Array, ...]:
    """Evaluate K piecewise polynomials and their derivatives up to the order ``highest`` at s, see `piecewise`."""
    if is_traced(s):
        return _traced_jet(breaks, coefficients, s, highest)
    s = np.asarray(s, dtype=float)
    index = np.clip(np.searchsorted(breaks, s, side="right") - 1, 0, len(breaks) - 2)
    gathered = np.moveaxis(coefficients[index], (-1, -2), (0, 1))  # power, function, shape of s
    return _horner(list(gathered), s - breaks[index], highest)


def _horner(coefficients: list[Any], s: Any, highest: int) -> tuple[Any, ...]:
    """Return value and derivatives of one polynomial, or of several at once."""
    values = []
    for order in range(highest + 1):
        if order:
            coefficients = [j * c for j, c in enumerate(coefficients)][1:] or [0.0 * coefficients[0]]
        value = coefficients[-1] + 0.0 * s
        for c in coefficients[-2::-1]:
            value = value * s + c
        values.append(value)
    return tuple(values)


@lru_cache(maxsize=256)
def _horner_function(functions: int, degree: int, highest: int) -> Any:
    """Return the scalar CasADi function (coefficients, powers outermost; local argument) → value and derivatives."""
    c, s = ca.SX.sym("c", functions * (degree + 1)), ca.SX.sym("s")
    parts = [c[functions * j : functions * (j + 1)] for j in range(degree + 1)]
    return ca.Function("horner", [c, s], list(_horner(parts, s, highest)))


@lru_cache(maxsize=64)
def _constant(numbers: bytes) -> Any:
    """Return numbers as a column of a trace, always the same node, so that a function holds each table once."""
    return ca.MX(ca.DM(np.frombuffer(numbers)))


def _traced_jet(breaks: np.ndarray, coefficients: np.ndarray, s: Any, highest: int) -> tuple[Array, ...]:
    symbol = s.to_casadi()
    if s.ndim or not isinstance(symbol, ca.MX):
        raise TraceError(
            f"found a traced argument of {s.ndim} dimensions and of the kind {type(symbol).__name__} for a table; "
            "expected a scalar of the kind MX. Trace in MX, and look up one argument at a time."
        )
    pieces, functions, powers = coefficients.shape
    stride = functions * powers
    places, table = _constant(breaks.tobytes()), _constant(np.swapaxes(coefficients, 1, 2).tobytes())
    index = ca.low(places, symbol) if pieces > 1 else ca.MX(0)
    gathered = table[stride * index + ca.DM(np.arange(stride))]
    values = _horner_function(functions, powers - 1, highest)(gathered, symbol - places[index])
    values = values if isinstance(values, tuple) else (values,)
    return tuple(as_traced(ArrayInterface(ca.densify(v).T, ndim=1)) for v in values)


def bilinear(rows: np.ndarray, columns: np.ndarray, values: np.ndarray, a: Array, b: Array) -> Array:
    """Interpolate a table at (a, b): bilinear in each cell, with the outermost cells continued.

    With the cell rows[i] ≤ a < rows[i + 1], columns[j] ≤ b < columns[j + 1] and α, β from 0 to 1 in it,
    f = (1 − α)(1 − β) v_ij + α (1 − β) v_(i+1)j + (1 − α) β v_i(j+1) + α β v_(i+1)(j+1). Derivatives are exact.
    """
    wide = len(columns)
    i: Any
    j: Any
    corners: Any
    if is_traced(a):
        sought, places = (a.to_casadi(), b.to_casadi()), [_constant(rows.tobytes()), _constant(columns.tobytes())]
        if not all(isinstance(symbol, ca.MX) for symbol in sought):
            raise TraceError("found traced arguments of another kind for a table; expected MX. Trace in MX.")
        i, j = (ca.low(at, symbol) if at.numel() > 2 else ca.MX(0) for at, symbol in zip(places, sought, strict=True))
        table = _constant(np.ascontiguousarray(values).tobytes())
        corners = ca.vertsplit(table[wide * i + j + ca.DM([0, 1, wide, wide + 1])])
        alpha, beta = (
            as_traced(ArrayInterface((symbol - at[k]) / (at[k + 1] - at[k]), ndim=0))
            for symbol, at, k in zip(sought, places, (i, j), strict=True)
        )
        corners = [as_traced(ArrayInterface(corner, ndim=0)) for corner in corners]
    else:
        i = int(np.clip(np.searchsorted(rows, a, side="right") - 1, 0, len(rows) - 2))
        j = int(np.clip(np.searchsorted(columns, b, side="right") - 1, 0, wide - 2))
        alpha, beta = (a - rows[i]) / (rows[i + 1] - rows[i]), (b - columns[j]) / (columns[j + 1] - columns[j])
        corners = [values[i, j], values[i, j + 1], values[i + 1, j], values[i + 1, j + 1]]
    v00, v01, v10, v11 = corners
    low, high = v00 + beta * (v01 - v00), v10 + beta * (v11 - v10)
    return low + alpha * (high - low)
