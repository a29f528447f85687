"""The admittance that an environment feels at the plant of a diagram, and its passivity.

Y(jω) = dᵀṗ/F along the direction d of the contact, in m/(N s). In a sampled loop F(t) = e^{jωt} acts in continuous
time, the inputs of the plant are held, and Y is the fundamental of the velocity: the mean of dᵀṗ(t) e^{−jωt} over a
sample. It does not contain the aliases of ω. In several rates the mean is that over the period: the velocity contains
other frequencies, too, ω + 2πk/T, and Y is its part at ω alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ...blocks.core import Array, Finding, OptionError, brief, count_of, explain_calls
from ..frequency import refine_sign_change
from .contact_loop import Joined, close_loop, join_environment
from .coupled_parts import ContactParts


@explain_calls
@dataclass(frozen=True, eq=False)
class ContactAdmittance:
    """Admittance at a contact over frequencies.

    Attributes
    ----------
    omega : ndarray
        Frequencies in rad/s.
    rendered : ndarray
        Admittance that the environment feels, m/(N s).
    target : ndarray or None
        Admittance of the diagram's `AdmittanceFilter` in this direction, with velocities in m/s; None where there is
        none, or the direction is not that of one filter.
    findings : tuple of Finding
        Effects that the linear model leaves out.
    """

    omega: np.ndarray
    rendered: np.ndarray
    target: np.ndarray | None
    findings: tuple[Finding, ...] = ()

    def __repr__(self) -> str:
        facts = (
            count_of(np.size(self.omega), "frequency"),
            "with a target" if self.target is not None else "",
        )
        return brief("admittance at a contact, m/(N s)", *facts, then=".omega, .rendered, .target")


AROUND = 0.05
"""Part of a frequency within which the admittance's real part changes its sign next to a limit."""


def look_again(parts: ContactParts, direction: np.ndarray, omega: float) -> float:
    """Return the stiffness ω/|Y| at which Re Y(jω) = 0 next to a frequency in rad/s; NaN without one."""
    low, high = (1.0 - AROUND) * omega, (1.0 + AROUND) * omega
    if not 0.0 < low < high < (math.pi / parts.shortest if parts.shortest else math.inf):
        return math.nan

    def real(w: float) -> float:
        return float(compute_admittance(parts, direction, np.array([w]))[0].real)

    if not real(low) * real(high) < 0.0:
        return math.nan
    w = refine_sign_change(real, low, high, xtol=2e-12 * omega, rtol=1e-12)
    return w / float(np.abs(compute_admittance(parts, direction, np.array([w]))[0]))


def compute_admittance(parts: ContactParts, direction: np.ndarray, omega: Array) -> np.ndarray:
    """Return the admittance along a direction, m/(N s)."""
    w, T = np.asarray(omega, dtype=float), parts.shortest
    top = math.pi / T if T else math.inf
    if not np.all((w > 0.0) & (w < top)):
        raise OptionError(
            f"found frequencies from {np.min(w):g} to {np.max(w):g} rad/s; expected them positive"
            f"{f', below the Nyquist frequency {top:.6g} rad/s' if T else ''}. Leave the others out.",
            port="omega",
        )
    return _sampled(parts, direction, w) if T else _continuous(parts, direction, w)


def _continuous(parts: ContactParts, direction: np.ndarray, w: np.ndarray) -> np.ndarray:
    joined = join_environment(parts, direction)
    loop = close_loop(parts, joined)
    push = loop.at_tick.copy()
    push[: len(joined.A)] += joined.G
    x = np.linalg.solve(1j * w[..., None, None] * np.eye(len(loop.A)) - loop.A, push.astype(complex))
    return np.asarray(((direction @ parts.velocity) @ x[..., : len(joined.A), :])[..., 0])


def _sampled(parts: ContactParts, direction: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Return the fundamental; states at a tick are taken relative to F at that tick."""
    joined = join_environment(parts, direction)
    loop = close_loop(parts, joined)
    n, many = joined.B.shape
    turning = {tick.duration: _turn(joined, w, tick.duration) for tick in parts.controllers}
    steps = []
    for step, tick in zip(loop.every_step, parts.controllers, strict=True):
        z, push, mean = turning[tick.duration]
        drive = np.broadcast_to(step.at_tick, (*w.shape, *step.at_tick.shape)).astype(complex)
        drive[..., :n, :] += push
        steps.append((z, step, drive, mean, tick.duration))
    # over the period: z s = A s + drive, each relative to F at its tick
    z, A, drive = steps[0][0], loop.A, steps[0][2]
    for z_k, step, drive_k, *_ in steps[1:]:
        drive = step.A @ drive + z * drive_k
        z = z * z_k
    states = np.linalg.solve(z * np.eye(len(A)) - A, drive)
    velocity = np.concatenate([direction @ parts.velocity, np.zeros(many + 1)])
    found: np.ndarray = np.zeros(w.shape, dtype=complex)
    for z_k, step, drive_k, mean, duration in steps:
        by_state, by_force = step.inputs
        u = by_state @ states + by_force
        now = np.concatenate([states[..., :n, :], u, np.ones((*w.shape, 1, 1))], axis=-2)
        share = duration / parts.sample_time if parts.ticks else 1.0
        found = found + share * (velocity @ (mean @ now))[..., 0]
        if parts.ticks:
            states = (step.A @ states + drive_k) / z_k
    return found


def _turn(joined: Joined, w: np.ndarray, T: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return e^{jωT}, the states that F = e^{jωt} makes over the time T, and the mean of (x, u, F) e^{−jωt} over it."""
    from scipy.linalg import expm

    n, many = joined.B.shape
    every = n + many + 1
    # x, the held u and F = e^{jωt} as one system, times e^{−jωt}, and its mean over a sample
    turning = np.zeros((*w.shape, 2 * every, 2 * every), dtype=complex)
    turning[..., :n, :every] = np.concatenate([joined.A, joined.B, joined.G], axis=-1)
    turning[..., every - 1, every - 1] = 1j * w
    turning[..., :every, :every] -= 1j * w[..., None, None] * np.eye(every)
    turning[..., :every, every:] = np.eye(every) / T
    turned = np.asarray(expm(turning * T))
    z = np.exp(1j * w * T)[..., None, None]
    return z, z * turned[..., :n, every - 1 : every], turned[..., :every, every:]
