"""A sampled loop whose commands come late: the plant behind a delay and a hold, and the delay that the loop bears."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...blocks.core import ParameterError, accepts, kinds
from .number import Number, carries_findings
from .scan_refine_confirm import Candidate, find_first_limit
from .sensitivities import invert_loop
from .state_space import Matrices, hold_inputs, make_state_space, read_matrices

if TYPE_CHECKING:
    from control import StateSpace

    from .state_space import LinearSystem


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
    Phi, _ = hold_inputs(P.A, P.B, sample_time)
    rest, new = hold_inputs(P.A, P.B, sample_time - fraction)
    old = rest @ hold_inputs(P.A, P.B, fraction)[1]
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
        A = loop.A - loop.B @ invert_loop(np.eye(len(loop.D)) + loop.D) @ loop.C
        return float(np.max(np.abs(np.linalg.eigvals(A)))) - 1.0

    if radius(0.0) >= 0:
        raise ParameterError(
            f"found a closed-loop pole with |z| = {1 + radius(0.0):.6g} without any delay; expected |z| < 1. Look at "
            "margins(loop).closed_loop_poles.",
            block="delayed_hold_margin",
        )
    how = "closed-loop eigenvalues with the delayed hold"
    found = find_first_limit(radius, 0.0, (0.1 * T * k for k in range(1, int(10 * largest) + 1)))
    if found is None:
        return Number(np.inf, "s", 0.0, f"{how}: stable up to {largest:g} samples")
    limit = Candidate.of_limit("delayed_hold_margin", found, "s", 1e-10 * found, lambda delay: radius(delay) < 0, how)
    return limit.confirmed()
