"""The loop of a diagram against an environment at its plant, as matrices.

The plant is ẋ = A x + B u + B_F F, y = C x + D u + D_F F, with the position p = C_p x and the velocity ṗ = C_v x of the
contact. The environment pushes along the unit vector d: F = d f with

    f = F_ext − k_e dᵀp − b_e dᵀṗ − m_e dᵀp̈,      p̈ = C_v (A x + B u + B_F d f)

which is solved for f: the mass moves along with the plant. The force sensor shows d f, and less by the inertia of a
tool that is heavier by Δm than the diagram's own: −Δm p̈.

Sampled, plant and environment run in continuous time under held inputs u, by the matrix exponential, and the
controller computes once a tick. f and p̈ are measured under the last inputs; so are all outputs of an FMU. The outputs
of a plant with equations are those under the new inputs, as in a run of the diagram. Continuous, f and u contain each
other: that loop is solved as if nothing took time.

In several rates the period has several ticks. The loop over the period is the product of those from each tick to the
next, and its poles z are those of the period.

Modes that the environment can't reach or doesn't feel stay as they are, whatever its properties, such as a drift in
another direction. `split_modes` finds them by controllability and observability, not by the place of their poles.

A mode's pole z over the time T gives its frequency up to multiples of 2π/T, and its sign. `find_frequency` takes that
of the strongest part of the motion in continuous time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...blocks.core import Array, ParameterError, accepts
from ..frequency import advance_held, hold_inputs
from .coupled_parts import ContactParts
from .environment import VALUES
from .held_signals import StateMatrices

SLOW, SLOW_RATE = 1e-3, 1.0
"""Distance of |z| from 1, and rate in 1/s, within which a stable mode is looked at."""
_RANK = 1e-9
"""Part of a direction, relative to the directions found before, below which it is no further one."""
_SAFETY = 10.0
"""Factor on the rounding of a matrix, for the routines that it goes through."""


class Joined(NamedTuple):
    """Plant and environment: ẋ = A x + B u + G F_ext, its outputs, and the force that the sensor feels.

    ``y`` and ``felt`` hold the matrices by x, by u and by F_ext. All have the axes of a batch in front.
    """

    A: np.ndarray
    B: np.ndarray
    G: np.ndarray
    y: tuple[np.ndarray, np.ndarray, np.ndarray]
    felt: tuple[np.ndarray, np.ndarray, np.ndarray]


class Rows(NamedTuple):
    """Inputs of the controller at a tick, by x, by the last u, by the new u and by F_ext."""

    x: np.ndarray
    last: np.ndarray
    now: np.ndarray
    force: np.ndarray


@accepts("environment", ParameterError, stiffness=VALUES, damping=VALUES, mass=VALUES, tool_mass=VALUES.or_none())
def join_environment(
    parts: ContactParts,
    direction: np.ndarray,
    stiffness: Array = 0.0,
    damping: Array = 0.0,
    mass: Array = 0.0,
    tool_mass: Array | None = None,
) -> Joined:
    """Return the plant with spring, damper and mass along a direction; properties may be arrays, to be broadcast."""
    tool = parts.tool_mass if tool_mass is None else tool_mass
    k, b, m, more = (
        np.asarray(v, dtype=float)[..., None, None]
        for v in np.broadcast_arrays(stiffness, damping, mass, np.asarray(tool, dtype=float) - parts.tool_mass)
    )
    plant, d = parts.plant, direction[:, None]
    push = parts.force @ d
    along = d.T @ parts.velocity
    share = 1.0 / (1.0 + m * (along @ push))
    f_x = -share * (k * (d.T @ parts.position) + b * along + m * (along @ plant.A))
    f_u, f_F = -share * m * (along @ plant.B), share
    shown = parts.force_shown @ d
    A, B, G = plant.A + push @ f_x, plant.B + push @ f_u, push * f_F
    y = (plant.C + shown @ f_x, plant.D + shown @ f_u, shown * f_F)
    inertia = more * parts.velocity
    return Joined(A, B, G, y, (d @ f_x - inertia @ A, d @ f_u - inertia @ B, d * f_F - inertia @ G))


def controller_rows(parts: ContactParts, joined: Joined) -> Rows:
    """Return the inputs of the controller."""
    (yx, yu, yF), (fx, fu, fF) = joined.y, joined.felt
    zero_y, zero_f = np.zeros_like(yu), np.zeros_like(fu)
    if not parts.sample_time:
        parts_of_u = ((zero_y, yu), (zero_f, fu))
    else:
        parts_of_u = ((yu, zero_y) if parts.is_stepped else (zero_y, yu), (fu, zero_f))
    (y_last, y_now), (f_last, f_now) = parts_of_u

    def stack(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.concatenate([a, b], axis=-2)

    return Rows(stack(yx, fx), stack(y_last, f_last), stack(y_now, f_now), stack(yF, fF))


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """The coupled loop: s⁺ (or ds/dt) = A s + g F at the ticks, with the plant's state first.

    The states are those of the plant, the last inputs (of a sampled loop) and those of the controller. ``inputs`` are
    the matrices of u by the states and by F at the tick. ``solvable`` is False where a continuous loop has no solution.
    ``steps`` holds the loops from tick to tick, of which A is the product, where there are several; the matrices by F
    are those of the first.
    """

    A: np.ndarray
    at_tick: np.ndarray
    inputs: tuple[np.ndarray, np.ndarray]
    joined: Joined
    solvable: np.ndarray
    steps: tuple[ClosedLoop, ...] = ()

    @property
    def every_step(self) -> tuple[ClosedLoop, ...]:
        """The loops from tick to tick: at least one."""
        return self.steps or (self,)


def close_loop(parts: ContactParts, joined: Joined) -> ClosedLoop:
    """Return the loop of joined plant and controller."""
    rows = controller_rows(parts, joined)
    if not parts.ticks:
        held = hold_inputs(joined.A, joined.B, parts.sample_time) if parts.sample_time else None
        return _close_tick(parts, joined, rows, parts.controller, held)
    holds = {T: hold_inputs(joined.A, joined.B, T) for T in {tick.duration for tick in parts.ticks}}
    steps = tuple(_close_tick(parts, joined, rows, tick.matrices, holds[tick.duration]) for tick in parts.ticks)
    A = steps[0].A
    for step in steps[1:]:
        A = step.A @ A
    return ClosedLoop(A, steps[0].at_tick, steps[0].inputs, joined, steps[0].solvable, steps)


def _close_tick(
    parts: ContactParts, joined: Joined, rows: Rows, K: StateMatrices, held: tuple[np.ndarray, np.ndarray] | None
) -> ClosedLoop:
    """Return the loop from one tick to the next; ``held`` has the matrices between them, None in continuous time."""
    sampled = held is not None
    batch, (n, many), nk = joined.A.shape[:-2], parts.plant.B.shape, len(K.A)
    E = np.eye(many) - K.D @ rows.now
    solvable = np.linalg.det(E) > 0.0 if not sampled else np.ones(batch, dtype=bool)
    E_inv = np.linalg.inv(np.where(solvable[..., None, None], E, np.eye(many)))
    u_x, u_last, u_k, u_F = (E_inv @ v for v in (K.D @ rows.x, K.D @ rows.last, K.C, K.D @ rows.force))
    u_k = np.broadcast_to(u_k, (*batch, many, nk))
    u = np.concatenate([u_x, *([u_last] if sampled else []), u_k], axis=-1)
    h = np.concatenate([rows.x, *([rows.last] if sampled else []), np.zeros((*batch, rows.x.shape[-2], nk))], axis=-1)
    h, h_F = h + rows.now @ u, rows.force + rows.now @ u_F
    Ad, Bd = (joined.A, joined.B) if held is None else held
    own_x = np.concatenate([Ad, np.zeros((*batch, n, u.shape[-1] - n))], axis=-1)
    own_k = np.concatenate([np.zeros((*batch, nk, u.shape[-1] - nk)), np.broadcast_to(K.A, (*batch, nk, nk))], axis=-1)
    A = np.concatenate([own_x + Bd @ u, *([u] if sampled else []), own_k + K.B @ h], axis=-2)
    at_tick = np.concatenate([Bd @ u_F, *([u_F] if sampled else []), K.B @ h_F], axis=-2)
    return ClosedLoop(np.where(solvable[..., None, None], A, np.nan), at_tick, (u, u_F), joined, solvable)


@dataclass(frozen=True, eq=False)
class Modes:
    """Coordinates that split the modes that an environment moves from the others."""

    left: np.ndarray  # left @ A @ right is the matrix of the modes that the environment can move
    right: np.ndarray
    fixed: np.ndarray  # poles of the others, s or z
    growing: np.ndarray  # which of the others grow by more than rounding; a drift doesn't

    def reduce(self, A: np.ndarray) -> np.ndarray:
        """Return the matrix of the modes that the environment can move."""
        return np.asarray(self.left @ A @ self.right)


def split_modes(parts: ContactParts, direction: np.ndarray, loop: ClosedLoop, used: set[str]) -> Modes:
    """Return the modes that an environment can move, which is made of the properties ``used``.

    An environment reaches modes through its force, over a sample and at a tick; it feels them by the position if it has
    a spring, by the velocity if it has a damper, and by the acceleration if it has a mass. A tool's mass feels all
    directions, and acts at the ticks.
    """
    from scipy.linalg import matrix_balance

    T, A = parts.sample_time, loop.A
    n, nf = len(parts.plant.A), len(direction)
    axes = np.eye(nf) if "tool_mass" in used else direction[:, None]
    d = direction[:, None]
    size, many = len(A), parts.plant.B.shape[1]
    at_ticks = []
    for axis in axes.T[:, :, None]:
        free = join_environment(parts, axis[:, 0])
        at_ticks.append(close_loop(parts, free._replace(G=0.0 * free.G)).every_step)
    push = parts.force @ d

    def row(by_x: np.ndarray, by_u: np.ndarray) -> np.ndarray:
        made = np.zeros((len(by_x), size))
        made[:, :n] = by_x
        if T:
            made[:, n : n + many] = by_u
        else:
            made += by_u @ loop.inputs[0]
        return made

    none, rows = np.zeros((1, many)), []
    if "stiffness" in used:
        rows.append(row(d.T @ parts.position, none))
    if "damping" in used:
        rows.append(row(d.T @ parts.velocity, none))
    if "mass" in used or "tool_mass" in used:
        by = parts.velocity if "tool_mass" in used else d.T @ parts.velocity
        rows.append(row(by @ loop.joined.A, by @ loop.joined.B))
    pushes, felt = np.zeros((size, 0)), np.zeros((0, size))  # at the end of the period, and at its beginning
    until = np.eye(size)
    for k, (step, tick) in enumerate(zip(loop.every_step, parts.controllers, strict=True)):
        along = np.zeros((size, 1))
        along[:n] = hold_inputs(loop.joined.A, push, tick.duration)[1] if T else push
        now = [one[k].at_tick for one in at_ticks]
        pushes = np.hstack([step.A @ pushes if k else pushes, *now, along])
        felt = np.vstack([felt, *(r @ until for r in rows)])
        until = step.A @ until if loop.steps else until
    shifted = A - np.eye(size) if T else A
    balanced, scale = matrix_balance(shifted, permute=False, separate=True)
    scale = scale[0]
    V, fixed, growing = _split_fixed(balanced, pushes / scale[:, None], bool(T))
    W, more, grow = _split_fixed((V.T @ balanced @ V).T, (felt * scale @ V).T, bool(T))
    poles = np.concatenate([fixed, more]) + (1.0 if T else 0.0)
    return Modes(W.T @ V.T / scale, scale[:, None] * (V @ W), poles, np.concatenate([growing, grow]))


def _split_fixed(A: np.ndarray, B: np.ndarray, sampled: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a basis of what is left without the slow and unstable modes that B doesn't reach, their poles, which grow.

    The basis spans a subspace that A, and A + B F for every F, leads into itself. Its modes are those of (A, B); A is
    z − 1 in a sampled loop.
    """
    from scipy.linalg import schur

    def is_slow(re: float, im: float) -> bool:
        return abs(1.0 + complex(re, im)) > 1.0 - SLOW if sampled else re > -SLOW_RATE

    _, right, count = schur(A, sort=is_slow)
    _, left, again = schur(A.T, sort=is_slow)
    if not count or again != count:
        return np.eye(len(A)), np.zeros(0), np.zeros(0, dtype=bool)
    right, left = right[:, :count], left[:, :count]
    dual = np.linalg.solve(left.T @ right, left.T)  # dual @ right is the unit matrix
    inner = dual @ A @ right
    size = float(np.linalg.norm(A, 2))
    rest, least = _not_reached(inner, dual @ B, np.linalg.norm(B, axis=0), size)
    if not rest.shape[1]:
        return np.eye(len(A)), np.zeros(0), np.zeros(0, dtype=bool)
    whole, _ = np.linalg.qr(dual.T @ rest, mode="complete")
    own = rest.T @ inner @ rest
    poles = np.linalg.eigvals(own)
    # Schur's form is exact for a matrix n ε |A| away, z − 1 has the rounding of z; the projection on the slow modes
    # enlarges that by |dual|, and the subspace that B reaches is known to it over its least singular value (Wedin).
    unit = _SAFETY * len(A) * float(np.finfo(float).eps)
    rounding = unit * (size + float(sampled)) * float(np.linalg.norm(dual, 2)) / least
    return whole[:, rest.shape[1] :], poles, np.array([_grows(own, p, rounding, sampled) for p in poles], dtype=bool)


def _grows(A: np.ndarray, pole: complex, rounding: float, sampled: bool) -> bool:
    """Whether a pole is unstable for more than the rounding of its matrix, which is that of z − 1 in a sampled loop.

    A pole that rounding has moved from the border has all its way there within the pseudospectrum of that rounding:
    |A − s|⁻¹ is large at every s between, whether the pole stood alone or several in one place. Halfway is looked at,
    since a drift is on the border where another pole's way may end.
    """
    place = complex(pole) + float(sampled)
    if (abs(place) <= 1.0) if sampled else (place.real <= 0.0):
        return False
    border = place / abs(place) if sampled else 1j * place.imag
    halfway = 0.5 * (place + border) - float(sampled)
    return bool(np.linalg.svd(A - halfway * np.eye(len(A)), compute_uv=False)[-1] > rounding)


def _not_reached(A: np.ndarray, B: np.ndarray, lengths: np.ndarray, size: float) -> tuple[np.ndarray, float]:
    """Return an orthonormal basis of what B does not reach through A, and the least part that counts as reached.

    ``lengths`` are the sizes of the columns of B, ``size`` that of A, to which rounding is relative.
    """
    n = len(A)
    V, new, reference, least = np.zeros((n, 0)), B, lengths, 1.0
    while new.shape[1] and V.shape[1] < n:
        rest = new / np.where(reference > 0.0, reference, 1.0)
        for _ in range(2):  # twice, against rounding
            rest = rest - V @ (V.T @ rest)
        U, s, _ = np.linalg.svd(rest, full_matrices=False)
        found = U[:, s > _RANK]
        V = np.hstack([V, found])
        least = min(least, float(s[s > _RANK].min(initial=1.0)))
        new, reference = A @ found, np.full(found.shape[1], size)
    whole, _ = np.linalg.qr(V, mode="complete")
    return whole[:, V.shape[1] :], least


SAMPLES = 16
"""Samples of the motion in the shortest time between ticks."""
STRONGER = 1.01
"""Factor by which a part must be stronger than one of a lower frequency."""
_ROUNDED = 1e-9
"""Entry of a unit vector below which it is rounding."""


def find_direction(parts: ContactParts, direction: np.ndarray, state: np.ndarray) -> tuple[float, ...]:
    """Return the unit vector of the largest motion of the contact in a mode, towards the environment's direction."""
    n = len(parts.plant.A)
    moved = parts.position @ state[:n]
    if np.linalg.norm(moved) <= _ROUNDED * np.linalg.norm(np.abs(parts.position) @ np.abs(state[:n])):
        moved = parts.velocity @ state[:n]
    axis = np.linalg.svd(np.stack([moved.real, moved.imag], axis=-1))[0][:, 0]
    towards = axis @ direction
    if abs(towards) <= _ROUNDED:  # across the environment: towards the first axis that it has a part in
        towards = axis[int(np.argmax(np.abs(axis) > _ROUNDED))]
    axis = axis if towards >= 0.0 else -axis
    return tuple(float(v) if abs(v) > _ROUNDED else 0.0 for v in axis)


def find_frequency(parts: ContactParts, loop: ClosedLoop, rate: complex, state: np.ndarray) -> float:
    """Return the frequency in rad/s of a mode."""
    T = parts.sample_time
    if not T:
        return float(abs(rate.imag))
    t, weights, velocity = _follow(parts, loop, state)
    turns = math.ceil(0.25 * SAMPLES * T / parts.shortest)
    aliases = rate.imag + 2.0 * math.pi / T * np.arange(-turns, turns + 1)
    aliases = aliases[np.argsort(np.abs(aliases), kind="stable")]
    decays = np.exp(-np.outer(rate.real + 1j * aliases, t)) * weights
    sizes = np.linalg.norm(decays @ velocity, axis=1)
    return float(abs(aliases[int(np.argmax(sizes * STRONGER >= np.max(sizes)))]))


def _follow(parts: ContactParts, loop: ClosedLoop, state: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times over the period, their weights, and the velocities of the contact at them."""
    joined, n = loop.joined, len(parts.plant.A)
    times, weights, velocities, begin = [], [], [], 0.0
    for step, tick in zip(loop.every_step, parts.controllers, strict=True):
        count = math.ceil(SAMPLES * tick.duration / parts.shortest)
        h = tick.duration / count
        here = advance_held(joined.A, joined.B, 0.5 * h) @ np.concatenate([state[:n], step.inputs[0] @ state])
        further = advance_held(joined.A, joined.B, h)
        for i in range(count):
            times.append(begin + (i + 0.5) * h)
            weights.append(h)
            velocities.append(parts.velocity @ here[:n])
            here = further @ here
        state, begin = step.A @ state, begin + tick.duration
    return np.array(times), np.array(weights), np.array(velocities)
