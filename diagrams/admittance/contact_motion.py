"""The motion of a mode of a coupled loop: its direction at the contact, and its frequency.

A pole z over the time T tells a frequency up to multiples of 2π/T, and its sign. The motion in continuous time tells
which of them it is: that of its strongest part.
"""

from __future__ import annotations

import math

import numpy as np

from .contact_loop import ClosedLoop
from .contact_parts import ContactParts

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
    """Return the frequency in rad/s of a mode.

    Parameters
    ----------
    parts : ContactParts
        Plant and controller.
    loop : ClosedLoop
        The coupled loop, without axes of a batch.
    rate : complex
        Its pole in 1/s.
    state : ndarray
        State of the mode at the beginning of the period.
    """
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
    from scipy.linalg import expm

    joined = loop.joined
    n, many = joined.B.shape
    whole = np.zeros((n + many, n + many))
    whole[:n, :n], whole[:n, n:] = joined.A, joined.B
    times, weights, velocities, begin = [], [], [], 0.0
    for step, tick in zip(loop.every_step, parts.controllers, strict=True):
        count = math.ceil(SAMPLES * tick.duration / parts.shortest)
        h = tick.duration / count
        here = expm(whole * 0.5 * h) @ np.concatenate([state[:n], step.inputs[0] @ state])
        further = expm(whole * h)
        for i in range(count):
            times.append(begin + (i + 0.5) * h)
            weights.append(h)
            velocities.append(parts.velocity @ here[:n])
            here = further @ here
        state, begin = step.A @ state, begin + tick.duration
    return np.array(times), np.array(weights), np.array(velocities)
