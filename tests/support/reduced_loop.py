"""Fig. 3's compliance loop, reduced to a linear model by hand: an oracle of `AdmittanceLoop`.

With the names of `loopwright.diagrams.paper.compliance_loop`, robot and environment are one continuous system:

    (M + m_e) p̈ = u − (C + b_e) ṗ − k_e p + F                                          plant
    F_meas = F − k_e p − b_e ṗ − (m_e + m_tool) p̈                                      force sensor

u is the motor force and F any other force; M contains the mass of a tool beyond the sensor. The controller's equations
are those of that module, sampled as its blocks sample them. Nothing here is taken from a diagram.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq


class StateMatrices(NamedTuple):
    """State-space matrices; axes in front of the last two are those of a batch."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray


def plant_matrices(loop, stiffness=0.0, damping=0.0, mass=0.0, tool_mass=None):
    """Return the matrices of robot and environment, from (u, F) to (p, ṗ, F_meas) with the states (p, ṗ).

    Stiffness in N/m, damping in N s/m and masses in kg may be arrays; the matrices then have their axes in front.
    """
    n = len(loop.directions)
    M, C = loop.motions[0]
    there = np.diag([float(s == loop.side) for s in loop.directions])  # the environment acts in one direction
    tool = loop.tool_mass if tool_mass is None else tool_mass
    k, b, m, tool = (
        v[..., None, None]
        for v in np.broadcast_arrays(*(np.asarray(x, dtype=float) for x in (stiffness, damping, mass, tool)))
    )
    eye, zero = np.eye(n), np.zeros((*k.shape[:-2], n, n))
    W = np.linalg.inv(M + m * there)
    on_p, on_v = -W @ (k * there), -W @ (C + b * there)  # p̈ = on_p p + on_v ṗ + W (u + F)
    felt = m * there + tool * eye
    A = _join_blocks([[zero, zero + eye], [on_p, on_v]])
    B = _join_blocks([[zero, zero], [W, W]])
    C_ = _join_blocks([[zero + eye, zero], [zero, zero + eye], [-k * there - felt @ on_p, -b * there - felt @ on_v]])
    D = _join_blocks([[zero, zero], [zero, zero], [-felt @ W, eye - felt @ W]])
    return StateMatrices(A, B, C_, D)


def controller_matrices(loop):
    """Matrices of the controller from (p, ṗ, F_meas) to u; its states are ∫(w − e) dt, e, ė, and the delayed u."""
    n, T = len(loop.directions), loop.sample_time
    eye, zero = np.eye(n), np.zeros((n, n))
    Q_inv = np.diag([1.0 / loop.q if s == "par" else 1.0 for s in loop.directions])
    pids, filters = ([parts[s] for s in loop.directions] for parts in (loop.pids, loop.filters))
    a2, a1, a0 = np.diag([p.a2 for p in pids]), np.diag([p.a1 for p in pids]), np.diag([p.a0 for p in pids])
    m_inv, k = np.diag([1.0 / a.mass for a in filters]), np.diag([a.stiffness for a in filters])
    d = np.diag([a.effective_damping for a in filters])
    M, C = loop.motions[1]
    MQ = M @ np.linalg.inv(Q_inv)
    phi = loop.feed_forward * m_inv
    D = np.hstack([-MQ @ a1 @ Q_inv, -MQ @ a2 @ Q_inv + C, MQ @ phi - loop.cancelled * eye])
    C_ = MQ @ np.hstack([-a0, a1 - phi @ k, a2 - phi @ d])
    if loop.implementation != "sampled":
        A = np.block([[zero, -eye, zero], [zero, zero, eye], [zero, -m_inv @ k, -m_inv @ d]])
        B = np.block([[Q_inv, zero, zero], [zero, zero, zero], [zero, zero, m_inv]])
        return StateMatrices(A, B, C_, D)
    made = [a.constants(T, loop.method) for a in filters]
    step = [[np.diag([c["transition"][i, j] for c in made]) for j in range(2)] for i in range(2)]
    push = [np.diag([c["forcing"][i, 1] for c in made]) @ m_inv for i in range(2)]
    A = np.block([[eye, -T * eye, zero], [zero, *step[0]], [zero, *step[1]]])
    B = np.block([[T * Q_inv, zero, zero], [zero, zero, push[0]], [zero, zero, push[1]]])
    for _ in range(loop.delay):  # u waits one more sample
        A = np.block([[A, np.zeros((len(A), n))], [C_, np.zeros((n, n))]])
        B, C_ = np.vstack([B, D]), np.hstack([np.zeros((n, len(A) - n)), eye])
        D = np.zeros((n, 3 * n))
    return StateMatrices(A, B, C_, D)


def hold_force(plant, T, n):
    """Return the plant under a motor force that is held over T; the last force is a state, since it gave the last p̈."""
    A, B = plant.A, plant.B[..., :n]
    batch, x = A.shape[:-2], A.shape[-1]
    whole = np.zeros((*batch, x + n, x + n))
    whole[..., :x, :x], whole[..., :x, x:] = A, B
    whole = np.asarray(expm(whole * T))
    none = np.zeros((*batch, n, n))
    A = _join_blocks([[whole[..., :x, :x], np.zeros((*batch, x, n))], [np.zeros((*batch, n, x)), none]])
    B = _join_blocks([[whole[..., :x, x:]], [none + np.eye(n)]])
    return StateMatrices(A, B, _join_blocks([[plant.C, plant.D[..., :n]]]), np.zeros((*batch, 3 * n, n)))


def _join_blocks(rows):
    """Return the matrix of these blocks; axes in front of the last two are those of a batch."""
    return np.concatenate([np.concatenate(row, axis=-1) for row in rows], axis=-2)


def close_loop(loop, **environment):
    """System matrix of the coupled loop, continuous or over one sample.

    ``environment`` is that of `poles`. It is NaN if the continuous equations have no solution: the force that
    is fed back through the acceleration would change its sign.
    """
    if loop.implementation == "ideal":
        return _close_ideal_loop(loop, **environment)
    n = len(loop.directions)
    plant, K = plant_matrices(loop, **environment), controller_matrices(loop)
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


def _close_ideal_loop(loop, stiffness=0.0, damping=0.0, mass=0.0, tool_mass=None):
    a, q = loop.admittance, loop.scale
    tool = loop.tool_mass if tool_mass is None else tool_mass
    k, b, m, tool = np.broadcast_arrays(*(np.asarray(v, dtype=float) for v in (stiffness, damping, mass, tool)))
    A = np.zeros((*k.shape, 2, 2))
    inertia = a.mass + q * (m + tool)
    A[..., 0, 1] = 1.0
    A[..., 1, 0], A[..., 1, 1] = -(a.stiffness + q * k) / inertia, -(a.effective_damping + q * b) / inertia
    return A


def growth_rate(loop, **environment):
    """σ in 1/s of the coupled loop; infinite where the continuous equations have no solution."""
    A = close_loop(loop, **environment)
    solvable = np.isfinite(A).all(axis=(-1, -2))
    poles = np.linalg.eigvals(np.where(solvable[..., None, None], A, 0.0)).astype(complex)
    sampled = loop.implementation == "sampled"
    # a coupled direction without environment and without stiffness has a pole of pure drift
    drift = sum(loop.filters[s].stiffness == 0.0 for s in loop.directions if s != loop.side)
    order = np.argsort(np.abs(poles - (1.0 if sampled else 0.0)), axis=-1)
    poles = np.take_along_axis(poles, order, axis=-1)[..., drift:]
    rates = np.log(np.where(poles == 0.0, 1e-300, poles)) / loop.sample_time if sampled else poles
    return np.where(solvable, np.max(rates.real, axis=-1), np.inf)


ENDS = {"stiffness": (1e-2, 1e8), "damping": (1e-3, 1e6), "mass": (1e-4, 1e4), "tool_mass": (1e-4, 1e4)}
"""Ends of the scan of each property."""


class Limit(NamedTuple):
    """First value of a property from which the loop grows, the changes beyond it, and the frequency there."""

    value: float
    restabilizes: tuple[float, ...]
    frequency: float


def stability_limit(loop, over="stiffness", **environment):
    """Limit by a fine scan and SciPy's root search."""

    def growth(x):
        return float(growth_rate(loop, **{over: x}, **environment))

    grid = np.geomspace(*ENDS[over], 1001)
    grows = growth_rate(loop, **{over: grid}, **environment) > 1e-9
    changes = [
        brentq(growth, grid[i], grid[i + 1], xtol=1e-300, rtol=1e-14) for i in np.flatnonzero(grows[1:] != grows[:-1])
    ]
    if grows[0] or not changes:
        return Limit(0.0 if grows[0] else np.inf, tuple(changes), np.nan)
    poles = np.linalg.eigvals(close_loop(loop, **{over: changes[0]}, **environment)).astype(complex)
    if loop.implementation == "sampled":
        poles = np.log(np.where(poles == 0.0, 1e-300, poles)) / loop.sample_time
    return Limit(changes[0], tuple(changes[1:]), abs(poles[np.argmax(poles.real)].imag))


def negative_intervals(loop, low, high):
    """Ends of the intervals of frequencies in which the real part of the admittance is negative."""

    def real(w):
        Y = rendered_admittance(loop, np.asarray(w))
        return Y.real / np.abs(Y) + 1e-10  # less is rounding

    grid = np.geomspace(low, high, 2001)
    negative = real(grid) < 0.0
    edges = [
        float(brentq(real, grid[i], grid[i + 1], xtol=1e-300, rtol=1e-13))
        for i in np.flatnonzero(negative[1:] != negative[:-1])
    ]
    edges = [low] * bool(negative[0]) + edges + [high] * bool(negative[-1])
    return list(zip(edges[::2], edges[1::2], strict=True))


def rendered_admittance(loop, w):
    """Admittance that the environment feels at frequencies in rad/s; the fundamental of a sampled loop."""
    if loop.implementation == "ideal":
        s, a, q = 1j * w, loop.admittance, loop.scale
        return q * s / ((a.mass + q * loop.tool_mass) * s * s + a.effective_damping * s + a.stiffness)
    return _continuous_admittance(loop, w) if loop.implementation == "continuous" else _sampled_admittance(loop, w)


def _continuous_admittance(loop, w):
    n, i = len(loop.directions), loop.directions.index(loop.side)
    plant, K = plant_matrices(loop), controller_matrices(loop)
    D_u, D_F = plant.D[:, :n], plant.D[:, [n + i]]
    u = np.linalg.inv(np.eye(n) - K.D @ D_u) @ K.D @ D_F
    push = np.vstack([plant.B[:, [n + i]] + plant.B[:, :n] @ u, K.B @ (D_F + D_u @ u)])
    A = close_loop(loop)
    return np.linalg.solve(1j * w[..., None, None] * np.eye(len(A)) - A, push.astype(complex))[..., n + i, 0]


def _drive_states(loop, push, force):
    """Return the input matrix of the sampled loop for F.

    ``push`` moves the plant within one sample; ``force`` is the part of F that the sensor shows at once.
    """
    n, K = len(loop.directions), controller_matrices(loop)
    P = hold_force(plant_matrices(loop), loop.sample_time, n)
    u = K.D @ force
    on_plant = np.concatenate([push, np.zeros((*push.shape[:-2], n, 1))], axis=-2)
    on_k = np.broadcast_to(K.B @ force, (*push.shape[:-2], len(K.A), 1))
    return np.concatenate([on_plant + P.B @ u, on_k], axis=-2)


def _sampled_admittance(loop, w):
    n, i, T = len(loop.directions), loop.directions.index(loop.side), loop.sample_time
    plant, K = plant_matrices(loop), controller_matrices(loop)
    x, every = 2 * n, 3 * n + 1
    # (p, ṗ), the held u and F = e^{jωt} as one system, times e^{−jωt}, and its mean over a sample
    turning = np.zeros((*w.shape, 2 * every, 2 * every), dtype=complex)
    turning[..., :x, :x] = plant.A
    turning[..., :x, x : x + n] = plant.B[:, :n]
    turning[..., :x, x + n] = plant.B[:, n + i]
    turning[..., every - 1, every - 1] = 1j * w
    turning[..., :every, :every] -= 1j * w[..., None, None] * np.eye(every)
    turning[..., :every, every:] = np.eye(every) / T
    turned = np.asarray(expm(turning * T))
    z = np.exp(1j * w * T)[..., None, None]
    push, mean = z * turned[..., :x, every - 1 : every], turned[..., :every, every:]
    shown = plant.D[:, [n + i]]
    A = close_loop(loop)
    states = np.linalg.solve(z * np.eye(len(A)) - A, _drive_states(loop, push, shown))
    y = hold_force(plant, T, n).C @ states[..., : 3 * n, :] + shown
    u = K.C @ states[..., 3 * n :, :] + K.D @ y
    now = np.concatenate([states[..., :x, :], u, np.ones((*w.shape, 1, 1))], axis=-2)
    return (mean @ now)[..., n + i, 0]
