"""Discretization: the step of a continuous linear block over one sample, with its inputs held."""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np

from ..core import ParameterError, SampleTimeError, accepts, check_argument, kinds
from .symbolic_hold import hold_of_symbols, holds_symbols

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
