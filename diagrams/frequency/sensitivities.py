"""Sensitivity functions of a closed loop, and how much delay a plant behind a hold really bears."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...blocks.core.errors import ConfirmationError, ParameterError
from .number import Number


@dataclass(frozen=True, eq=False)
class GangOfFour:
    """The four transfer functions of a closed loop of plant P and controller C, u = −C y.

    Parameters
    ----------
    S : control.StateSpace
        Sensitivity 1/(1 + P C): reference to error.
    PS : control.StateSpace
        Load disturbance to output.
    CS : control.StateSpace
        Noise to command.
    T : control.StateSpace
        Complementary sensitivity P C/(1 + P C).
    """

    S: Any
    PS: Any
    CS: Any
    T: Any


def sensitivity(loop: Any) -> Any:
    """Return S = (I + L)⁻¹ of a square loop as a state space on L's states."""
    return _closed(loop, complementary=False)


def complementary(loop: Any) -> Any:
    """Return T = (I + L)⁻¹ L of a square loop as a state space on L's states."""
    return _closed(loop, complementary=True)


def gang_of_four(plant: Any, controller: Any) -> GangOfFour:
    """Return S, PS, CS and T as state spaces, all on the states of plant and controller.

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
    x, n, m = np.eye(P.noutputs), P.nstates + C.nstates, P.noutputs
    # y = P (d − C w), w = y + r: from r and d to y and C w, once, on the joint states
    zero = np.zeros((C.nstates, P.nstates))
    inverse = _solved(x + P.D @ C.D)
    Cy = inverse @ np.hstack([P.C, -P.D @ C.C])
    Dy = inverse @ np.hstack([-P.D @ C.D, P.D])
    select = np.hstack([np.eye(m), np.zeros((m, P.ninputs))])
    Cw, Dw = Cy, Dy + select
    Cu = np.hstack([np.zeros((C.noutputs, P.nstates)), C.C]) + C.D @ Cw
    Du = C.D @ Dw
    load = np.hstack([np.zeros((P.ninputs, m)), np.eye(P.ninputs)])
    A = np.block([[P.A, np.zeros((P.nstates, C.nstates))], [zero, C.A]])
    A = A + np.vstack([-P.B @ Cu, C.B @ Cw]) if n else A
    B = np.vstack([P.B @ (load - Du), C.B @ Dw])
    PS = control.ss(A, B[:, m:], Cy, Dy[:, m:], S.dt)
    CS = control.ss(A, B[:, :m], Cu, Du[:, :m], S.dt)
    T = control.ss(A, B[:, :m], -Cy, -Dy[:, :m], S.dt)
    return GangOfFour(S, PS, CS, T)


def delayed_hold(plant: Any, sample_time: float, delay: float = 0.0) -> Any:
    """Return a continuous plant behind a zero-order hold and a delay, exactly, as a sampled state space.

    The delay need not be whole samples: within a tick the old command acts for its fraction, then the new one
    (the modified z-transform). The plant must be strictly proper.

    Parameters
    ----------
    plant : control.StateSpace
        Continuous plant.
    sample_time : float
        T in s.
    delay : float
        Delay in s between tick and hold.
    """
    import control
    from scipy.linalg import expm

    P = control.ss(plant)
    if P.dt != 0 or np.any(P.D):
        raise ParameterError(
            f"found dt={P.dt} and D={P.D.tolist()}; expected a continuous plant without direct feedthrough.",
            block="delayed_hold",
        )
    if not (sample_time > 0 and delay >= 0):
        raise ParameterError(
            f"found a sample time of {sample_time} s and a delay of {delay} s; expected T > 0 and a delay ≥ 0.",
            block="delayed_hold",
        )
    n, m = P.nstates, P.ninputs
    samples = int(np.floor(delay / sample_time * (1 + 1e-14)))
    fraction = max(0.0, delay - samples * sample_time)

    def over(t: float) -> tuple[np.ndarray, np.ndarray]:
        both = expm(np.block([[P.A, P.B], [np.zeros((m, n + m))]]) * t)
        return both[:n, :n], both[:n, n:]

    Phi, _ = over(sample_time)
    rest, new = over(sample_time - fraction)
    old = rest @ over(fraction)[1]
    kept = samples + (fraction > 0)  # commands underway: u[k − 1], u[k − 2], …
    if not kept:
        return control.ss(Phi, new, P.C, 0, sample_time)
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
    return control.ss(A, B, np.hstack([P.C, np.zeros((P.noutputs, states - n))]), 0, sample_time)


def delayed_hold_margin(plant: Any, controller: Any, *, largest: float = 200.0) -> Number:
    """Return the delay in s between controller and hold at which a sampled loop ends to be stable, exactly.

    The first such delay on a scan of a tenth of a sample, refined; the loop may become stable again beyond.

    Parameters
    ----------
    plant : control.StateSpace
        Continuous plant.
    controller : control.StateSpace
        Sampled controller, u = −C y.
    largest : float
        Where the scan ends, in samples.

    Raises
    ------
    ParameterError
        If the loop is not stable without delay.
    """
    import control
    from scipy.optimize import brentq

    C = control.ss(controller)
    T = C.dt

    def radius(delay: float) -> float:
        loop = delayed_hold(plant, T, delay) * C
        A = loop.A - loop.B @ _solved(np.eye(len(loop.D)) + loop.D) @ loop.C
        return float(np.max(np.abs(np.linalg.eigvals(A)))) - 1.0

    if radius(0.0) >= 0:
        raise ParameterError(
            f"found a closed loop with |z| = {1 + radius(0.0):.6g} without any delay; expected a stable one.",
            block="delayed_hold_margin",
        )
    step = 0.1 * T
    k = next((k for k in range(1, int(10 * largest) + 1) if radius(k * step) >= 0), None)
    if k is None:
        return Number(np.inf, "s", 0.0, f"eigenvalues with the delayed hold: stable up to {largest:g} samples")
    found = float(brentq(radius, (k - 1) * step, k * step, xtol=1e-15 * T, rtol=1e-14))
    low, high = radius(0.99 * found), radius(1.01 * found)
    if not low < 0 < high:
        raise ConfirmationError(
            f"found {found:.9g} s, but |z| − 1 is {low:.3g} at 0.99 and {high:.3g} at 1.01 of it; expected a change of "
            "sign.",
            block="delayed_hold_margin",
        )
    how = "closed-loop eigenvalues with the delayed hold: stable at 0.99, unstable at 1.01 of it"
    return Number(found, "s", 1e-10 * found, how)


def _solved(M: np.ndarray) -> np.ndarray:
    if np.linalg.cond(M) > 1e12:
        raise ParameterError("found I + L singular at infinite frequency: an algebraic loop.", block="sensitivity")
    return np.asarray(np.linalg.inv(M))


def _closed(loop: Any, *, complementary: bool) -> Any:
    import control

    L = control.ss(loop)
    inverse = _solved(np.eye(len(L.D)) + L.D)
    A = L.A - L.B @ inverse @ L.C
    if complementary:
        return control.ss(A, L.B @ inverse, inverse @ L.C, inverse @ L.D, L.dt)
    return control.ss(A, L.B @ inverse, -inverse @ L.C, inverse, L.dt)
