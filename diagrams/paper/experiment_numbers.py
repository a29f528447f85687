"""Key numbers of a run of an experiment: what a control engineer reads off first."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from ..results import Run
    from .experiments import Experiment

CLOSE = 0.01
"""Difference from a closed form, relative to its size, up to which the closed form holds: sampling adds some."""
SCATTER = 1e-3
"""Relative spread of poles up to which they are one: of a triple pole roots differ by the third root of rounding."""
BAND = 0.02
"""Half-width of the band of the settling time, relative to the step."""

DEFINITIONS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "settling_par": ("s", "time from the step along the path until its response stays within 2 % of the step"),
        "settling_perp": ("s", "the same across the path"),
        "overshoot_par": (
            "1",
            "how far that response goes beyond its final value, as a part of the step; 0 if it does not",
        ),
        "overshoot_perp": ("1", "the same across the path"),
        "rms_par": ("m", "root mean square of the tracking error eta_1 - eta_1^p over the whole run"),
        "rms_perp": ("m", "root mean square of the tracking error xi_1 - xi_1^p over the whole run"),
        "max_error_par": ("m", "largest |eta_1 - eta_1^p| of the whole run"),
        "max_error_perp": ("m", "largest |xi_1 - xi_1^p| of the whole run"),
        "peak_speed": ("m/s", "largest speed of the end effector"),
        "peak_acceleration": ("m/s2", "largest acceleration of the end effector, as the plant gives it at the ticks"),
        "peak_motor_force_y": ("N", "largest |motor force| of the y axis"),
        "peak_motor_force_z": ("N", "largest |motor force| of the z axis"),
        "offset_par": ("m", "eta_1 minus its set-point under the first F_par^d, at the last tick before that changes"),
        "offset_perp": ("m", "xi_1 minus its set-point under the first F_perp^d, at the last tick before that changes"),
        "xi_step_motion": ("m", "peak to peak of xi_1 from the first step of F_par^d to the next step of any"),
        "force_error_final": (
            "N",
            "|F_perp - F_perp^d| at the last tick, where the force is what is tracked (k_perp = 0)",
        ),
        "force_error_moving": (
            "N",
            "largest |F_perp - F_perp^d| while eta^d moves, where the force is what is tracked",
        ),
        "end_time": ("s", "time of the last tick that was recorded"),
        "real_time_factor": ("1", "simulated over elapsed time of the loop"),
    }
)
"""Every key number: its unit and what it is."""


def key_numbers(experiment: Experiment, run: Run) -> dict[str, float | None]:
    """Return the key numbers of a run, in SI units, by the names of `DEFINITIONS`.

    The *step* of a direction, whose settling time and overshoot are given, is the first one that acts on it:

    * without admittance (A): the initial tracking error, and the response is the way from it to zero. Its closed form
      is 1 − (1 + p t − p² t²) e^{−pt} for a triple pole at −p, with an overshoot of 0.248935.
    * with stiffness k (B): the first step of the rest position, set-point − F^d/k, and the response is that of the
      coordinate, η₁ or ξ₁, relative to η^d or ξ^d. The closed form of the overshoot is exp(−π ζ/√(1 − ζ²)).
    * without stiffness, with a desired force (D, ⊥): the first step of F^d, and the response is that of the measured
      force.

    It is looked at from the tick of the step until any reference, set-point or desired force changes next, or the
    experiment ends; a run that stopped before shows nothing of it.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    run : Run
        Its run, a complete one or what ``error.run`` holds.

    Returns
    -------
    dict
        Every name of `DEFINITIONS`. None where there is nothing to measure, or the run stopped too early; an infinite
        settling time where the response does not settle before the next change.
    """
    numbers: dict[str, float | None] = dict.fromkeys(DEFINITIONS)
    if not len(run.t):
        return numbers
    sides = {side: _Side(experiment, run, side) for side in ("par", "perp")}
    complete = bool(run.t[-1] >= experiment.duration * (1.0 - 1e-9))
    changes = np.flatnonzero(np.any([side.changes for side in sides.values()], axis=0))
    ends = [*changes.tolist(), *([len(run.t)] if complete else [])]
    for name, side in sides.items():
        error = side.y - side.path_reference
        numbers[f"rms_{name}"] = float(np.sqrt(np.mean(error**2)))
        numbers[f"max_error_{name}"] = float(np.max(np.abs(error)))
        numbers[f"settling_{name}"], numbers[f"overshoot_{name}"] = _response(run.t, *side.step(), ends)
        numbers[f"offset_{name}"] = side.offset(complete)
    force = np.max(np.abs(run["motor_force"]), axis=0)
    numbers |= {
        "peak_speed": _largest(run["velocity"]),
        "peak_acceleration": _largest(run["plant.acceleration"]),
        "peak_motor_force_y": float(force[0]),
        "peak_motor_force_z": float(force[1]),
        "end_time": float(run.t[-1]),
        "real_time_factor": run.real_time_factor if np.isfinite(run.real_time_factor) else None,
    }
    par, perp = sides["par"], sides["perp"]
    steps = np.flatnonzero(np.diff(par.desired_force))
    if par.admittance and perp.admittance and steps.size and (end := _end(ends, int(steps[0]) + 1)):
        numbers["xi_step_motion"] = float(np.ptp(perp.y[int(steps[0]) + 1 : end]))
    if perp.tracks_force:
        error = np.abs(perp.force - perp.desired_force)
        numbers["force_error_final"] = float(error[-1]) if complete else None
        if np.any(moving := par.reference[:, 1] != 0.0):
            numbers["force_error_moving"] = float(np.max(error[moving]))
    return numbers


@dataclass(frozen=True)
class Theory:
    """The value of a key number by its closed form, and the size that a difference is relative to."""

    value: float
    size: float

    def holds(self, number: float | None) -> bool:
        """Return whether there is a number, and it is within 1 % of the size."""
        return number is not None and abs(number - self.value) <= CLOSE * self.size


def theory_numbers(experiment: Experiment, run: Run) -> dict[str, Theory]:
    """Return the closed forms of key numbers, by name, as far as they hold for the experiment's parameters.

    * The error of a triple pole overshoots by 5 e⁻³ on its way to zero, whatever the pole is.
    * An admittance in free space: overshoot exp(−π ζ/√(1 − ζ²)), offset −F^d/k.
    * Without stiffness the force is the desired one at rest.
    """
    found: dict[str, Theory] = {}
    if not len(run.t):
        return found
    for name in ("par", "perp"):
        side = _Side(experiment, run, name)
        if not side.admittance:
            block: Any = experiment.diagram.blocks[f"controller.pid_{name}"]
            poles = np.array(block.poles)
            if np.ptp(poles.real) + np.ptp(poles.imag) < SCATTER * abs(np.mean(poles)):
                found[f"overshoot_{name}"] = _relative(5.0 * math.exp(-3.0))
        elif side.tracks_force:
            found["force_error_final"] = Theory(0.0, float(np.max(np.abs(side.desired_force))))
        elif side.stiffness and not np.any(side.force):
            zeta = side.damping_ratio
            if 0.0 < zeta < 1.0:
                found[f"overshoot_{name}"] = _relative(math.exp(-math.pi * zeta / math.sqrt(1.0 - zeta**2)))
            if (force := side.first_force()) is not None:
                found[f"offset_{name}"] = _relative(-force / side.stiffness)
    return found


def _relative(value: float) -> Theory:
    return Theory(value, abs(value))


class _Side:
    """The signals of one direction."""

    def __init__(self, experiment: Experiment, run: Run, side: str):
        zero = np.zeros(len(run.t))
        coordinate = {"par": "eta", "perp": "xi"}[side]
        self.y = run[coordinate][:, 0]
        self.path_reference = run[f"{coordinate}_p"][:, 0]
        self.reference = run[f"{coordinate}_d.y"]
        self.force = run[f"controller.force_projection.f_{side}"]
        desired, set_point = f"desired_force_{side}.y", "set_point.y"
        self.has_desired_force = desired in run
        self.desired_force = run[desired] if self.has_desired_force else zero
        self.set_point = run[set_point] if side == "par" and set_point in run else zero
        block: Any = experiment.diagram.blocks.get(f"controller.admittance_{side}")
        self.admittance = block is not None
        self.stiffness = float(getattr(block, "stiffness", 0.0))
        self.block = block
        self.tracks_force = self.admittance and not self.stiffness and self.has_desired_force

    @property
    def damping_ratio(self) -> float:
        """ζ of the admittance, d/(2 √(m k)) where it has a damping d."""
        given = getattr(self.block, "damping_ratio", None)
        if given is not None:
            return float(given)
        return float(getattr(self.block, "damping", 0.0)) / (2.0 * math.sqrt(self.block.mass * self.stiffness))

    def first_force(self) -> float | None:
        """Return the first desired force that is not zero; None without any."""
        ticks = np.flatnonzero(self.desired_force)
        return float(self.desired_force[ticks[0]]) if ticks.size else None

    @property
    def changes(self) -> np.ndarray:
        """Whether, at each tick, anything that drives this direction differs from the tick before."""
        changed = np.zeros(len(self.y), dtype=bool)
        for signal in (self.reference[:, 0], self.desired_force, self.set_point):
            changed[1:] |= np.diff(signal) != 0.0
        return changed

    def step(self) -> tuple[int | None, np.ndarray]:
        """Return the tick of the step, and its response, which goes from 0 to 1."""
        if not self.admittance:
            error = self.y - self.path_reference
            return (0, 1.0 - error / error[0]) if error[0] else (None, error)
        if self.tracks_force:
            y, target = self.force, self.desired_force
        elif self.stiffness:
            y, target = self.y - self.reference[:, 0], self.set_point - self.desired_force / self.stiffness
        else:
            return None, self.y
        ticks = np.flatnonzero(np.diff(target, prepend=0.0))
        start = int(ticks[0]) if ticks.size else None
        if start is None or target[start] == y[start]:
            return None, y
        return start, (y - y[start]) / (target[start] - y[start])

    def offset(self, complete: bool) -> float | None:
        """Return where the first desired force has moved the coordinate to."""
        ticks = np.flatnonzero(np.diff(self.desired_force, prepend=0.0))
        if not self.stiffness or ticks.size + complete < 2:
            return None
        last = (int(ticks[1]) if ticks.size > 1 else len(self.y)) - 1
        return float(self.y[last] - self.reference[last, 0] - self.set_point[last])


def _end(ends: Sequence[int], start: int) -> int | None:
    """Return the tick at which what began at ``start`` ends; None if the run stopped before."""
    return next((end for end in ends if end > start), None)


def _response(
    t: np.ndarray, start: int | None, response: np.ndarray, ends: Sequence[int]
) -> tuple[float | None, float | None]:
    """Return settling time and overshoot of a response that goes from 0 to 1."""
    if start is None or (end := _end(ends, start)) is None:
        return None, None
    window = response[start:end]
    outside = np.flatnonzero(np.abs(window - 1.0) > BAND)
    settled = int(outside[-1]) + 1 if outside.size else 0
    settling = round(float(t[start + settled] - t[start]), 12) if settled < len(window) else float("inf")
    return settling, max(0.0, float(np.max(window)) - 1.0)


def _largest(vectors: np.ndarray) -> float:
    return float(np.max(np.linalg.norm(vectors, axis=1)))
