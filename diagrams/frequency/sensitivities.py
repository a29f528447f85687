"""Sensitivity functions of a closed loop, and the delay that a sampled loop bears in front of its hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...blocks.core import ConfirmationError, ParameterError, accepts, brief, explain_calls, kinds
from .carried import carries_findings
from .number import Number
from .sign_changes import refine_sign_change
from .state_space import Matrices, make_state_space, read_matrices

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
    inverse = _invert(x + P.D @ C.D)
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


@accepts(sample_time=kinds.finite, delay=kinds.finite)
@carries_findings
def delayed_hold(plant: LinearSystem, sample_time: float, delay: float = 0.0) -> StateSpace:
    """Return the exact sampled state space of a continuous plant behind a zero-order hold and a delay.

    The delay need not be whole samples: within a tick the old command acts for its fraction, then the new one
    (modified z-transform).

    Parameters
    ----------
    plant : control.StateSpace
        Continuous plant without direct feedthrough.
    sample_time : float
        T in s.
    delay : float
        Delay in s between tick and hold.

    Raises
    ------
    ParameterError
        If the plant is sampled or has direct feedthrough, or a time has the wrong sign.
    """
    return make_state_space(*_delay_hold(read_matrices(plant), sample_time, delay))


def _delay_hold(P: Matrices, sample_time: float, delay: float) -> Matrices:
    from scipy.linalg import expm

    if P.dt != 0 or np.any(P.D):
        raise ParameterError(
            f"found dt={P.dt} and D={P.D.tolist()}; expected a continuous plant without direct feedthrough. Leave "
            "sensor and actuator dynamics in the plant, or put the feedthrough into the controller.",
            block="delayed_hold",
        )
    if not (sample_time > 0 and delay >= 0):
        raise ParameterError(
            f"found a sample time of {sample_time} s and a delay of {delay} s; expected T > 0 and a delay ≥ 0. Give "
            "both in seconds.",
            block="delayed_hold",
        )
    n, m = P.states, P.inputs
    samples = int(np.floor(delay / sample_time * (1 + 1e-14)))
    fraction = max(0.0, delay - samples * sample_time)

    def hold_over(t: float) -> tuple[np.ndarray, np.ndarray]:
        both = np.asarray(expm(np.block([[P.A, P.B], [np.zeros((m, n + m))]]) * t))
        return both[:n, :n], both[:n, n:]

    Phi, _ = hold_over(sample_time)
    rest, new = hold_over(sample_time - fraction)
    old = rest @ hold_over(fraction)[1]
    kept = samples + (fraction > 0)  # commands underway: u[k − 1], u[k − 2], …
    none = np.zeros((P.outputs, m))
    if not kept:
        return Matrices(Phi, new, P.C, none, sample_time)
    states = n + m * kept
    A, B = np.zeros((states, states)), np.zeros((states, m))
    A[:n, :n] = Phi
    B[n : n + m] = np.eye(m)
    A[n + m :, n:-m] = np.eye(m * (kept - 1))
    for gain, lag in ((new, samples), (old, samples + 1))[: 1 + (fraction > 0)]:
        if lag == 0:
            B[:n] += gain
        else:
            A[:n, n + m * (lag - 1) : n + m * lag] += gain
    return Matrices(A, B, np.hstack([P.C, np.zeros((P.outputs, states - n))]), none, sample_time)


@accepts(controller=kinds.system, largest=kinds.finite)
@carries_findings
def delayed_hold_margin(plant: LinearSystem, controller: LinearSystem, *, largest: float = 200.0) -> Number:
    """Return the smallest delay in s between controller and hold that ends the stability of a sampled loop.

    A scan in steps of a tenth of a sample finds the delay, and a root search refines it. Beyond it the loop may become
    stable again.

    Parameters
    ----------
    plant : control.StateSpace
        Continuous plant without direct feedthrough.
    controller : control.StateSpace
        Sampled controller, u = −C y.
    largest : float
        End of the scan in samples.

    Raises
    ------
    ParameterError
        If the loop is not stable without delay.
    ConfirmationError
        If the loop is not stable at 0.99 and unstable at 1.01 of the delay.
    """
    import control

    C = control.ss(controller)
    T = float(C.dt)

    def radius(delay: float) -> float:
        loop = read_matrices(delayed_hold(plant, T, delay) * C)
        A = loop.A - loop.B @ _invert(np.eye(len(loop.D)) + loop.D) @ loop.C
        return float(np.max(np.abs(np.linalg.eigvals(A)))) - 1.0

    if radius(0.0) >= 0:
        raise ParameterError(
            f"found a closed-loop pole with |z| = {1 + radius(0.0):.6g} without any delay; expected |z| < 1. Look at "
            "margins(loop).closed_loop_poles.",
            block="delayed_hold_margin",
        )
    step = 0.1 * T
    k = next((k for k in range(1, int(10 * largest) + 1) if radius(k * step) >= 0), None)
    if k is None:
        return Number(np.inf, "s", 0.0, f"eigenvalues with the delayed hold: stable up to {largest:g} samples")
    found = refine_sign_change(radius, (k - 1) * step, k * step, xtol=1e-15 * T)
    low, high = radius(0.99 * found), radius(1.01 * found)
    if not low < 0 < high:
        raise ConfirmationError(
            f"found {found:.9g} s, but |z| − 1 is {low:.3g} at 0.99 and {high:.3g} at 1.01 of it; expected a change of "
            "sign. Scale the states of the plant: it may be ill-conditioned.",
            block="delayed_hold_margin",
        )
    how = "closed-loop eigenvalues with the delayed hold: stable at 0.99, unstable at 1.01 of it"
    return Number(found, "s", 1e-10 * found, how)


def _invert(M: np.ndarray) -> np.ndarray:
    if np.linalg.cond(M) > 1e12:
        raise ParameterError(
            "found I + L singular at infinite frequency, an algebraic loop; expected an inverse. Look at D of plant "
            "and controller.",
            block="sensitivity",
        )
    return np.asarray(np.linalg.inv(M))


def _close_loop(loop: LinearSystem, *, complementary: bool) -> StateSpace:
    L = read_matrices(loop)
    inverse = _invert(np.eye(len(L.D)) + L.D)
    A = L.A - L.B @ inverse @ L.C
    if complementary:
        return make_state_space(A, L.B @ inverse, inverse @ L.C, inverse @ L.D, L.dt)
    return make_state_space(A, L.B @ inverse, -inverse @ L.C, inverse, L.dt)
