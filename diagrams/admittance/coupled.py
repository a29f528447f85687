"""Poles and growth rate of the compliance loop coupled to an environment; `compliance_loop` derives the model.

Robot and environment, a mass m_e, a damper b_e and a spring k_e, make one closed loop. Its growth rate σ is the largest
real part of its poles, ln|z|/T in a sampled loop. It is stable if σ < 0.
"""

from __future__ import annotations

import numpy as np

from ...blocks.core import Array, accepts, kinds
from .compliance_loop import AdmittanceLoop, StateMatrices, check_environment, hold_force

ROBOT = kinds.one_of_class(AdmittanceLoop, "an AdmittanceLoop(…), such as AdmittanceLoop.of(diagram)")
"""Kind of the first argument of functions of a robot's admittance."""


def close_loop(loop: AdmittanceLoop, **environment: Array) -> np.ndarray:
    """Return the system matrix of the coupled loop, continuous or over one sample.

    ``environment`` is that of `poles`. The matrix is NaN if the continuous equations have no solution: the force that
    is fed back through the acceleration would change its sign.
    """
    if loop.implementation == "ideal":
        return _close_ideal_loop(loop, **environment)
    n = len(loop.directions)
    plant, K = loop.plant_matrices(**environment), loop.controller_matrices
    if loop.implementation == "sampled":
        P = hold_force(plant, loop.sample_time, n)
    else:
        P = StateMatrices(plant.A, plant.B[..., :n], plant.C, plant.D[..., :n])
    F = np.eye(n) - K.D @ P.D
    bad = np.linalg.det(F) <= 0.0
    F_inv = np.linalg.inv(np.where(bad[..., None, None], np.eye(n), F))
    on_x, on_k = F_inv @ K.D @ P.C, F_inv @ K.C  # u = on_x x + on_k x_k
    A = np.concatenate(
        [
            np.concatenate([P.A + P.B @ on_x, P.B @ on_k], axis=-1),
            np.concatenate([K.B @ (P.C + P.D @ on_x), K.A + K.B @ P.D @ on_k], axis=-1),
        ],
        axis=-2,
    )
    return np.where(bad[..., None, None], np.nan, A)


def _close_ideal_loop(
    loop: AdmittanceLoop,
    stiffness: Array = 0.0,
    damping: Array = 0.0,
    mass: Array = 0.0,
    tool_mass: Array | None = None,
) -> np.ndarray:
    check_environment(stiffness=stiffness, damping=damping, mass=mass, tool_mass=tool_mass)
    a, q = loop.admittance, loop.scale
    tool = loop.tool_mass if tool_mass is None else tool_mass
    k, b, m, tool = np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in (stiffness, damping, mass, tool)))
    A = np.zeros((*k.shape, 2, 2))
    inertia = a.mass + q * (m + tool)
    A[..., 0, 1] = 1.0
    A[..., 1, 0], A[..., 1, 1] = -(a.stiffness + q * k) / inertia, -(a.effective_damping + q * b) / inertia
    return A


@accepts(loop=ROBOT, stiffness=kinds.numbers, damping=kinds.numbers, mass=kinds.numbers, tool_mass=kinds.numbers)
def poles(
    loop: AdmittanceLoop,
    *,
    stiffness: Array = 0.0,
    damping: Array = 0.0,
    mass: Array = 0.0,
    tool_mass: Array | None = None,
) -> Array:
    """Return the poles of the coupled loop, s in 1/s or z.

    Parameters
    ----------
    loop : AdmittanceLoop
        Robot and controller.
    stiffness, damping, mass : float or array
        Environment: k_e in N/m, b_e in N s/m, m_e in kg. Arrays are broadcast.
    tool_mass : float or array, optional
        Mass of the tool in kg, in place of the loop's own.

    Returns
    -------
    ndarray
        Poles along the last axis, without the pure drift of a coupled direction that has neither environment nor
        stiffness.
    """
    return find_poles(loop, close_loop(loop, stiffness=stiffness, damping=damping, mass=mass, tool_mass=tool_mass))


def find_poles(loop: AdmittanceLoop, A: np.ndarray) -> np.ndarray:
    """Return the poles of matrices of `close_loop`; see `poles`."""
    solvable = np.isfinite(A).all(axis=(-1, -2))
    eigenvalues = np.linalg.eigvals(np.where(solvable[..., None, None], A, 0.0))
    values: np.ndarray = np.where(solvable[..., None], eigenvalues, np.nan)
    drift = 0 if loop.implementation == "ideal" else loop.drift_count
    if drift:
        rest = 1.0 if loop.implementation == "sampled" else 0.0
        order = np.argsort(np.abs(values - rest), axis=-1)
        values = np.take_along_axis(values, order, axis=-1)[..., drift:]
    return values


@accepts(loop=ROBOT, environment=kinds.numbers)
def growth_rate(loop: AdmittanceLoop, **environment: Array) -> Array:
    """Return σ in 1/s: the coupled loop grows like exp(σ t), and is stable if σ < 0.

    Parameters
    ----------
    loop : AdmittanceLoop
        Robot and controller.
    **environment
        Environment, as `poles` takes it.

    Returns
    -------
    float or ndarray
        σ; infinite where the continuous equations have no solution.
    """
    sigma = _find_fastest(loop, poles(loop, **environment))
    return float(sigma) if np.ndim(sigma) == 0 else sigma


def find_rates(loop: AdmittanceLoop, A: np.ndarray) -> np.ndarray:
    """Return the growth rates of matrices of `close_loop` in 1/s; see `growth_rate`."""
    return _find_fastest(loop, find_poles(loop, A))


def _find_fastest(loop: AdmittanceLoop, values: np.ndarray) -> np.ndarray:
    values = to_rates(loop, values)
    return np.asarray(np.where(np.isnan(values).any(axis=-1), np.inf, np.max(values.real, axis=-1)))


def to_rates(loop: AdmittanceLoop, values: np.ndarray) -> np.ndarray:
    """Return poles in 1/s: as they are, or s = ln z/T in a sampled loop."""
    if loop.implementation != "sampled":
        return values
    return np.asarray(np.log(np.where(np.abs(values) < 1e-300, 1e-300, values)) / loop.sample_time)


@accepts(loop=ROBOT, environment=kinds.number)
def crossing_frequency(loop: AdmittanceLoop, **environment: Array) -> float:
    """Return the frequency of the pole that grows fastest, rad/s."""
    values = to_rates(loop, poles(loop, **environment))
    return float(abs(values[np.argmax(values.real)].imag))


def growth_rate_by_control(loop: AdmittanceLoop, **environment: float) -> float:
    """Return σ in 1/s from python-control's discretization and feedback of plant and controller."""
    import control

    n = len(loop.directions)
    P, K = loop.plant_matrices(**environment), loop.controller_matrices
    if loop.implementation == "continuous":
        if np.linalg.det(np.eye(n) - K.D @ P.D[:, :n]) <= 0.0:
            return float("inf")
        plant = control.ss(P.A, P.B[:, :n], P.C, P.D[:, :n])
        values = np.asarray(control.feedback(plant, control.ss(*K), sign=1).poles())
    else:
        T = loop.sample_time
        sampled = control.sample_system(control.ss(P.A, P.B[:, :n], P.C, np.zeros((3 * n, n))), T, method="zoh")
        last = control.ss(np.zeros((n, n)), np.eye(n), P.D[:, :n], np.zeros((3 * n, n)), T)
        values = np.asarray(control.feedback(sampled + last, control.ss(*K, T), sign=1).poles())
    if loop.drift_count:
        rest = 0.0 if loop.implementation == "continuous" else 1.0
        values = values[np.argsort(np.abs(values - rest))][loop.drift_count :]
    return float(np.max(to_rates(loop, values).real))
