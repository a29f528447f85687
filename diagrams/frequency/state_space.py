"""Matrices of python-control's systems. python-control has no types, so its systems are read and made here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from ...blocks.core import Finding, ParameterError
from .transfer_functions import Coefficients, read_companion, realize

if TYPE_CHECKING:
    from control import StateSpace, TransferFunction

    LinearSystem: TypeAlias = StateSpace | TransferFunction

FourMatrices: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""A, B, C and D."""


class Matrices(NamedTuple):
    """State space ẋ = A x + B u, y = C x + D u, or x⁺ = A x + B u of a sampled system.

    ``dt`` is the sample time in s, 0 of a continuous system; None or True where python-control leaves it open.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    dt: float | None

    @property
    def states(self) -> int:
        """Number of states."""
        return len(self.A)

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return int(self.D.shape[1])

    @property
    def outputs(self) -> int:
        """Number of outputs."""
        return len(self.D)


def advance_held(A: np.ndarray, B: np.ndarray, T: float) -> np.ndarray:
    """Return the matrix that leads (x, u) of ẋ = A x + B u over the time T with u held; axes in front are a batch's."""
    from scipy.linalg import expm

    n, m = B.shape[-2:]
    both = np.zeros((*A.shape[:-2], n + m, n + m), dtype=np.result_type(A, B))
    both[..., :n, :n], both[..., :n, n:] = A, B
    return np.asarray(expm(both * T))


def hold_inputs(A: np.ndarray, B: np.ndarray, T: float) -> tuple[np.ndarray, np.ndarray]:
    """Return Ad and Bd of x(t + T) = Ad x + Bd u for ẋ = A x + B u with u held; axes in front are a batch's."""
    n = A.shape[-1]
    whole = advance_held(A, B, T)
    return whole[..., :n, :n], whole[..., :n, n:]


def read_matrices(system: LinearSystem) -> Matrices:
    """Return the matrices of a system of python-control; a transfer function is realized first."""
    # one with one channel is realized around z = 1 (`realize`), others by python-control; so is a sampled state space
    # in companion form, which is a transfer function in z, as `control.ss` makes of one
    polynomials = _read_polynomials(system)
    if polynomials is not None:
        sampled = system.dt is True or bool(system.dt)
        form = realize(*polynomials, sampled=sampled)
        if form is not None:
            A = form.A + np.eye(len(form.A)) * sampled
            return Matrices(A, form.B, form.C, form.D, system.dt)
    import control

    try:
        made = control.ss(system)
        A, B, C, D = (np.asarray(getattr(made, name), dtype=float) for name in "ABCD")
    except Exception as error:
        if hasattr(system, "omega"):
            raise ParameterError(
                f"found a {type(system).__name__}, measured data without poles; expected a control.StateSpace. The "
                "margins of data are measured_margins(data), with their uncertainty."
            ) from error
        if hasattr(system, "delays") and hasattr(system, "rest"):
            raise ParameterError(
                f"found a {type(system).__name__}, which has delays and no matrices; expected a control.StateSpace. "
                "Its approximation is system.pade(order); margins, disk_margin and nyquist_count take it as it is."
            ) from error
        if hasattr(system, "linearize") or hasattr(system, "loop"):
            made_of = "diagram.linearize()" if hasattr(system, "linearize") else "model"
            raise ParameterError(
                f"found a {type(system).__name__}; expected the loop at a wire. Give {made_of}.loop('wire'), with "
                "a wire's name."
            ) from error
        if isinstance(system, str):
            raise ParameterError(
                f"found {system!r}; expected the loop at a wire. Give diagram.linearize().loop({system!r})."
            ) from error
        raise ParameterError(
            f"found {type(system).__name__}, which python-control can't turn into a state space ({error}); expected "
            "a control.StateSpace. Make one with control.ss(A, B, C, D, dt)."
        ) from error
    return Matrices(A, B, C, D, made.dt)


def make_state_space(A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray, dt: float | None) -> StateSpace:
    """Return a system of python-control with these matrices."""
    import control

    return control.ss(A, B, C, D, dt)


def inexactness_of(system: LinearSystem) -> float:
    """Return the known error of a system's matrices, relative to their largest entry: of a loop with FMUs; else 0."""
    known = float(getattr(system, "inexactness", 0.0))
    return 0.0 if math.isnan(known) else known


def findings_of(system: LinearSystem) -> tuple[Finding, ...]:
    """Return the findings that a system carries: of a loop of a diagram those on it, else none."""
    found: tuple[Finding, ...] = getattr(system, "findings", ())
    return found


def read_coefficients(system: LinearSystem) -> Coefficients | None:
    """Return the coefficients of a sampled transfer function (or companion form) with one channel; None of others."""
    polynomials = _read_polynomials(system) if getattr(system, "dt", None) else None
    return None if polynomials is None else Coefficients(*(tuple(float(c) for c in row) for row in polynomials))


def _read_polynomials(system: LinearSystem) -> tuple[Sequence[float | Fraction], Sequence[float | Fraction]] | None:
    """Return numerator and denominator, as `read_coefficients` has them, the highest power first; None of others."""
    import control

    if (getattr(system, "ninputs", 0), getattr(system, "noutputs", 0)) != (1, 1):
        return None
    if isinstance(system, control.TransferFunction):
        return system.num[0][0], system.den[0][0]
    if isinstance(system, control.StateSpace) and (system.dt is True or system.dt) and not inexactness_of(system):
        A, B, C, D = (np.asarray(getattr(system, name), dtype=float) for name in "ABCD")
        return read_companion(A, B, C, D)
    return None
