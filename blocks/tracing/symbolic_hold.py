"""The step of a linear block over one sample as a function of its parameters, for code that is exported."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
from casadi import ArrayInterface

from .symbols import flat_column, wrap

_TERMS = 14  # of the exponential's series: at a norm of 1/2 the rest is 2e-17
_MOST_SQUARINGS = 16  # squarings: up to a norm of 3e4; beyond, the result is no number


def holds_symbols(rows: Any) -> bool:
    """Whether a matrix is one of symbols, or rows with symbols among their entries."""
    if isinstance(rows, ArrayInterface | ca.MX):
        return True
    return isinstance(rows, list | tuple) and any(holds_symbols(row) for row in rows)


def hold_of_symbols(rows: Any, T: float, method: str) -> tuple[Any, Any]:
    """Return Ad and Φ of `loopwright.hold` as arrays of symbols; see there."""
    A = _matrix(rows)
    n = A.size1()
    eye: Any = ca.MX(ca.DM.eye(n))
    if method == "forward":
        made = eye + T * A, T * eye
    elif method == "semi_implicit":
        upper = ca.triu(A, False)
        solve = ca.inv(eye - T * upper)
        made = solve @ (eye + T * (A - upper)), T * solve
    elif method == "trapezoidal":
        solve = ca.inv(eye - T / 2 * A)
        made = solve @ (eye + T / 2 * A), T * solve
    elif n == 1:
        made = _hold_of_one_state(A * T, T)
    else:
        both = exponential(ca.vertcat(ca.horzcat(A, eye), ca.MX(n, 2 * n)) * T)
        made = both[:n, :n], both[:n, n:]
    first, second = (wrap(ca.vec(ca.densify(part).T), (n, n)) for part in made)
    return first, second


def _hold_of_one_state(a: Any, T: float) -> tuple[Any, Any]:
    """Return e^a and T (e^a − 1)/a, the two of one state, which a person who reads the C code expects."""
    none = a == 0.0
    return ca.exp(a), T * ca.if_else(none, 1.0, ca.expm1(a) / (a + none))


def exponential(A: Any) -> Any:
    """Return exp(A) of a square matrix of symbols: Taylor's series of A scaled down, then squarings by its norm."""
    A = ca.densify(A)
    n = A.size1()
    eye: Any = ca.densify(ca.MX(ca.DM.eye(n)))
    norm = ca.mmax(ca.sum2(ca.fabs(A)))
    k = ca.fmax(ca.ceil(ca.log(norm + 1e-300) / np.log(2.0)) + 1.0, 0.0)
    scaled = A * ca.power(2.0, -k)
    found = eye
    for i in range(_TERMS, 0, -1):
        found = eye + (scaled @ found) / i
    for i in range(_MOST_SQUARINGS):
        found = ca.if_else(i < k, found @ found, found)
    return ca.if_else(k > _MOST_SQUARINGS, np.nan, found)


def _matrix(rows: Any) -> Any:
    if isinstance(rows, ca.MX):
        return rows
    if isinstance(rows, ArrayInterface):
        found = rows.to_casadi()
        return found if rows.ndim == 2 else ca.reshape(found, 1, 1)
    return ca.vertcat(*(ca.horzcat(*map(flat_column, row)) for row in _as_rows(rows)))


def _as_rows(rows: Any) -> Sequence[Any]:
    return rows if isinstance(rows[0], list | tuple) else [rows]
