"""Discretization: the step of a continuous block over one sample.

Of a linear block the inputs are held; where its parameters are symbols, for code that is exported, the step is a
function of them. A nonlinear block takes the trapezoidal step, solved by Newton's method in its trace.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

import casadi as ca
import numpy as np
from casadi import ArrayInterface

from ..core import ParameterError, SampleTimeError, accepts, check_argument, kinds
from .symbols import flat_column, wrap

Method = Literal["exact", "forward", "semi_implicit", "trapezoidal"]
_METHODS = get_args(Method)
METHOD = kinds.choice(*_METHODS).worded(
    f"one of {', '.join(_METHODS)}", found=lambda name, method: f"found the method {method!r}"
)
"""Kind of the name of a discretization."""


def check_method(method: str, block: str | None = None) -> None:
    """Raise `SampleTimeError` unless ``method`` names a discretization, that of a subsystem or block, say."""
    check_argument(method, METHOD, "method", block, SampleTimeError)


@accepts(A=kinds.matrix, T=kinds.number, method=kinds.text)
def hold(A: np.ndarray, T: float, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Return Ad and Φ of x(t + T) = Ad x + Φ g for ẋ = A x + g with g held over T.

    Parameters
    ----------
    A : (n, n) ndarray
        System matrix.
    T : float
        Sample time in s.
    method : {"exact", "forward", "semi_implicit", "trapezoidal"}
        ``exact`` is the zero-order hold, Ad = exp(A T) and Φ = ∫₀ᵀ exp(A s) ds. ``forward`` is forward Euler.
        ``semi_implicit`` is Euler with the states renewed from the last to the first, each from those already renewed:
        of (position, velocity) the velocity comes first, and the position uses the new one. ``trapezoidal`` is Ad = (I
        − A T/2)⁻¹ (I + A T/2) and Φ = T (I − A T/2)⁻¹, of second order: x(t + T) = x + T/2 (ẋ(t) + ẋ(t + T)). With g
        held it is not Tustin's method, which averages g over both ends.

    Raises
    ------
    SampleTimeError
        For another method, and for a trapezoidal step whose I − A T/2 is singular.
    """
    return find_hold(A, T, method)


def find_hold(A: Any, T: float, method: str) -> tuple[Any, Any]:
    """Return the matrices of `hold`, from arguments of known kinds: a sweep does so for each of its runs."""
    check_method(method, "hold")
    if holds_symbols(A):  # a block's parameters, where it is exported
        return hold_of_symbols(A, T, method)
    A = np.atleast_2d(np.asarray(A, dtype=float))
    n = len(A)
    if A.shape != (n, n):
        raise ParameterError(
            f"found a system matrix of shape {A.shape}; expected a square one.", block="hold", port="A"
        )
    eye = np.eye(n)
    if method == "forward":
        return eye + T * A, T * eye
    if method == "semi_implicit":
        upper = np.triu(A, 1)
        solve = np.linalg.inv(eye - T * upper)
        return solve @ (eye + T * (A - upper)), T * solve
    if method == "trapezoidal":
        try:
            solve = np.linalg.inv(eye - T / 2 * A)
        except np.linalg.LinAlgError:
            raise SampleTimeError(
                f"the trapezoidal step of {T:g} s has no solution: a pole is at 2/T = {2 / T:g} 1/s. Take a smaller "
                "sample time, or method='exact'."
            ) from None
        return solve @ (eye + T / 2 * A), T * solve
    from scipy.linalg import expm

    generator = np.zeros((2 * n, 2 * n))
    generator[:n, :n], generator[:n, n:] = A, eye
    both = expm(generator * T)
    return both[:n, :n], both[:n, n:]


# --- with symbols -----------------------------------------------------------------------------------------------------


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


# --- nonlinear blocks -------------------------------------------------------------------------------------------------


_NEWTON_STEPS = 5
_NEWTON_TOLERANCE = 1e-9  # of the correction after the last step, relative to each state and to its nominal value


def trapezoidal_step(rates: Any, arguments: list[Any], T: Any, nominals: np.ndarray) -> tuple[Any, Any]:
    """Return the states at the end of a step, x⁺ = x + T/2 (f(t, x, u) + f(t + T, x⁺, u)), and a guard; ``rates`` is f.

    The guard is negative if the correction that would follow is larger, for any state, than 1e-9 of it and its nominal
    value together. A NaN fails no guard: it passes on to the states.
    """
    # Newton's method starts from x (an explicit guess would be far off in a stiff block), has the exact Jacobian, and
    # takes a fixed number of steps. The linear equations are solved in scalar operations, about n³ of them if all
    # states are coupled: 10 such states take 0.4 s to trace and 0.2 ms a step, 20 take 3.5 s and 1 ms.
    t, x, *held = arguments
    n = x.numel()
    symbols = rates.mx_in()
    jacobian = ca.Function("jacobian", symbols, [ca.jacobian(rates(*symbols), symbols[1])])
    solve = _solver(ca.Sparsity.diag(n).unite(jacobian.sparsity_out(0)))
    start = rates(*arguments)
    new = x

    def newton(new: Any) -> tuple[Any, Any]:
        """Return the next correction, and the rates at the end."""
        after = rates(t + T, new, *held)
        matrix = ca.MX(ca.DM.eye(n)) - T / 2 * jacobian(t + T, new, *held)
        return solve(ca.project(matrix, solve.sparsity_in(0)), new - x - T / 2 * (start + after)), after

    for _ in range(_NEWTON_STEPS):
        new = new - newton(new)[0]
    left = ca.fabs(newton(new)[0])
    allowed = _NEWTON_TOLERANCE * (nominals + ca.fabs(new))
    return new, ca.mmin(ca.if_else(left > allowed, allowed - left, 1.0))


def _solver(sparsity: Any) -> Any:
    """Return A⁻¹b as a function of scalar operations (QR), so that the step expands to scalar operations too."""
    A, b = ca.SX.sym("A", sparsity), ca.SX.sym("b", sparsity.size1())
    return ca.Function("solve", [A, b], [ca.solve(A, b)])
