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

    first, second = control.ss(plant), control.ss(controller)
    S = sensitivity(first * second)
    P, C, dt = read_matrices(first), read_matrices(second), read_matrices(S).dt
    x, n, m = np.eye(P.outputs), P.states + C.states, P.outputs
    # y = P (d − C w), w = y + r: from r and d to y and C w, once, on the joint states
    zero = np.zeros((C.states, P.states))
    inverse = invert_loop(x + P.D @ C.D)
    Cy = inverse @ np.hstack([P.C, -P.D @ C.C])
    Dy = inverse @ np.hstack([-P.D @ C.D, P.D])
    select = np.hstack([np.eye(m), np.zeros((m, P.inputs))])
    Cw, Dw = Cy, Dy + select
    Cu = np.hstack([np.zeros((C.outputs, P.states)), C.C]) + C.D @ Cw
    Du = C.D @ Dw
    load = np.hstack([np.zeros((P.inputs, m)), np.eye(P.inputs)])
    A = np.block([[P.A, np.zeros((P.states, C.states))], [zero, C.A]])
    A = A + np.vstack([-P.B @ Cu, C.B @ Cw]) if n else A
    B = np.vstack([P.B @ (load - Du), C.B @ Dw])
    return GangOfFour(
        S=S,
        PS=make_state_space(A, B[:, m:], Cy, Dy[:, m:], dt),
        CS=make_state_space(A, B[:, :m], Cu, Du[:, :m], dt),
        T=make_state_space(A, B[:, :m], -Cy, -Dy[:, :m], dt),
    )


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
