"""Sensitivity functions of a closed loop as state spaces: S, T, and the gang of four."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...blocks.core import ParameterError, accepts, brief, explain_calls, kinds
from .number import carries_findings
from .state_space import make_state_space, read_matrices

if TYPE_CHECKING:
    from control import StateSpace

    from .state_space import LinearSystem


@explain_calls
@dataclass(frozen=True, eq=False)
class GangOfFour:
    """The four transfer functions of a closed loop of plant P and controller C, u = −C y.

    Parameters
    ----------
    S : control.StateSpace
        Sensitivity 1/(1 + P C), from reference to error.
    PS : control.StateSpace
        From load disturbance to output.
    CS : control.StateSpace
        From noise to command.
    T : control.StateSpace
        Complementary sensitivity P C/(1 + P C).
    """

    S: StateSpace
    PS: StateSpace
    CS: StateSpace
    T: StateSpace

    def __repr__(self) -> str:
        facts = f"{self.S.nstates} states", f"T = {self.S.dt:g} s" if self.S.dt else "continuous"
        return brief("gang of four", *facts, then=".S, .PS, .CS, .T")


@explain_calls
@carries_findings
def sensitivity(loop: LinearSystem) -> StateSpace:
    """Return S = (I + L)⁻¹ of a square loop, with L's states."""
    return _close_loop(loop, complementary=False)


@explain_calls
@carries_findings
def complementary(loop: LinearSystem) -> StateSpace:
    """Return T = (I + L)⁻¹ L of a square loop, with L's states."""
    return _close_loop(loop, complementary=True)


@accepts(plant=kinds.system, controller=kinds.system)
@carries_findings
def gang_of_four(plant: LinearSystem, controller: LinearSystem) -> GangOfFour:
    """Return S, PS, CS and T, all with the states of plant and controller.

    Parameters
    ----------
    plant, controller : control.StateSpace
        P and C of u = −C y, y = P u, both continuous or both of one sample time.

    Raises
    ------
    ParameterError
        If the loop is singular at infinite frequency.
    """
    import control

    P, C = control.ss(plant), control.ss(controller)
    S = sensitivity(P * C)
    # both side by side, with u = d − C w and w = r + y around them: from (d, r) to (y, C w), on the joint states
    inputs, outputs = P.ninputs, P.noutputs
    around = np.block([[np.zeros((inputs, outputs)), -np.eye(inputs)], [np.eye(outputs), np.zeros((outputs, inputs))]])
    closed = read_matrices(control.feedback(control.append(P, C), around, sign=1))
    d, r = slice(None, inputs), slice(inputs, None)
    y, u = slice(None, outputs), slice(outputs, None)

    def part(out: slice, into: slice, sign: float = 1.0) -> StateSpace:
        return make_state_space(
            closed.A, closed.B[:, into], sign * closed.C[out], sign * closed.D[out, into], closed.dt
        )

    return GangOfFour(S=S, PS=part(y, d), CS=part(u, r), T=part(y, r, -1.0))


def invert_loop(M: np.ndarray) -> np.ndarray:
    """Return (I + D)⁻¹ of a loop."""
    if np.linalg.cond(M) > 1e12:
        raise ParameterError(
            "found I + L singular at infinite frequency, an algebraic loop; expected an inverse. Look at D of plant "
            "and controller.",
            block="sensitivity",
        )
    return np.asarray(np.linalg.inv(M))


def _close_loop(loop: LinearSystem, *, complementary: bool) -> StateSpace:
    L = read_matrices(loop)
    inverse = invert_loop(np.eye(len(L.D)) + L.D)
    A = L.A - L.B @ inverse @ L.C
    if complementary:
        return make_state_space(A, L.B @ inverse, inverse @ L.C, inverse @ L.D, L.dt)
    return make_state_space(A, L.B @ inverse, -inverse @ L.C, inverse, L.dt)
