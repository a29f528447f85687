"""Limits of coupled stability of a diagram against an environment at its plant.

The loop of `contact_loop` is scanned over one property of the environment, with extrema of the growth rate between the
points; Brent's method refines each change of its sign.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from ...blocks.core import Array, Finding, OptionError, explain_calls, on_one_thread
from ..frequency import Number
from .contact_arguments import check_property, read_density, read_number, read_positive
from .contact_loop import ClosedLoop, Modes, close_loop, controller_rows, join_environment, split_modes
from .contact_motion import find_direction, find_frequency
from .contact_parts import ContactParts
from .growth_limits import (
    PER_DECADE,
    UNITS,
    FoundLimit,
    GrowthMap,
    describe_limit,
    find_first_limit,
    growth_rounding,
    scan_points,
)

FEWEST_PER_DECADE = 30
"""Fewest points of a scan in a decade: above k/M = (π/T)², stability changes several times in one."""
_ESTIMATED = 10.0
"""Factor by which a stated error of differences may be too small."""


@explain_calls
@dataclass(frozen=True)
class ContactLimit:
    """First value of one property of the environment at which a diagram loses its stability.

    Attributes
    ----------
    vary : str
        Property: ``"stiffness"``, ``"damping"``, ``"mass"`` or ``"tool_mass"``.
    value : float
        Limit; infinite if the loop is stable over the whole scan, 0 if it is unstable at its start.
    unit : str
        Unit of the limit.
    frequency : float
        Frequency in rad/s at which the loop oscillates there, 0 if it only grows; NaN without a limit. It is that of
        the strongest part of the motion in continuous time: a sampled loop's pole leaves it open up to its aliases.
    direction : tuple of float
        Unit vector, in the axes of the force, along which the unstable mode moves the contact most; empty without a
        limit. It need not be the direction of the environment.
    restabilizes : tuple of float
        Values beyond the limit at which the loop becomes stable again, then unstable, in turn.
    growth_below, growth_above : float
        Growth rate σ in 1/s at 0.97 and at 1.03 of the limit: of the fastest mode that the environment can move.
    scanned : tuple of float
        Ends of the scan.
    tolerance : float
        Bound of the value's numerical error, in its unit: of the computation, and of the plant's linear model where
        that is made of differences.
    confirmed_by : str
        Independent computation that agrees.
    environment : dict
        Properties that were held.
    findings : tuple of Finding
        Kinks and stairs of the diagram that the linear model leaves out.
    second_look : float
        Stiffness in N/m of a spring alone, from the admittance: ω/|Y| where Re Y(jω) = 0, beside the limit's frequency.
        It is the limit in continuous time. In a sampled loop, where Y is the fundamental, it differs by a part
        of (ω T)⁴, for the library's robots: 7e-4 at ω T = 0.5. T is the period of several rates.
        NaN for other environments, and without such a frequency.
    """

    vary: str
    value: float
    unit: str
    frequency: float
    direction: tuple[float, ...]
    restabilizes: tuple[float, ...]
    growth_below: float
    growth_above: float
    scanned: tuple[float, float]
    tolerance: float
    confirmed_by: str
    environment: dict[str, float] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    second_look: float = math.nan

    def __repr__(self) -> str:
        return describe_limit(self.vary, self)

    @property
    def number(self) -> Number:
        """The limit as a number of a report."""
        return Number(self.value, self.unit, self.tolerance, self.confirmed_by, findings=self.findings)


@explain_calls
@dataclass(frozen=True, eq=False, repr=False)
class ContactMap(GrowthMap):
    """Growth rates over two properties of the environment; see `GrowthMap` for ``x``, ``y`` and ``growth``.

    The growth rates are those of the modes that the environment can move, and of those that grow whatever it is.

    Attributes
    ----------
    limits : tuple of ContactLimit
        Limit of x at each value of y.
    """

    limits: tuple[ContactLimit, ...]


@dataclass(frozen=True, eq=False)
class CoupledLoop:
    """A contact with the properties of its environment that are held: growth rates by the one that is varied."""

    parts: ContactParts
    direction: np.ndarray
    vary: str
    held: Mapping[str, float]
    modes: Modes

    @classmethod
    def of(cls, parts: ContactParts, direction: np.ndarray, vary: str, held: Mapping[str, float]) -> CoupledLoop:
        """Return the coupled loop, with the modes split off that the environment can't move."""
        if "tool_mass" in {vary, *held}:
            parts.tool.check()
        used = {vary} | {name for name, value in held.items() if value and name != "tool_mass"}
        loop = close_loop(parts, join_environment(parts, direction, **held))
        return cls(parts, direction, vary, held, split_modes(parts, direction, loop, used))

    def close(self, value: Any) -> ClosedLoop:
        """Return the loop at values of the property."""
        return close_loop(self.parts, join_environment(self.parts, self.direction, **{**self.held, self.vary: value}))

    def growth(self, value: Any) -> np.ndarray:
        """Return σ in 1/s of the fastest mode that the environment can move; infinite without a solution."""
        return self._find_rates(self.close(value).A)

    def _find_rates(self, A: np.ndarray) -> np.ndarray:
        solvable = np.isfinite(A).all(axis=(-1, -2))
        poles = np.linalg.eigvals(self.modes.reduce(np.where(solvable[..., None, None], A, 0.0)))
        return np.where(solvable, np.max(to_rates(self.parts, poles).real, axis=-1), np.inf)

    def growth_at(self, value: float) -> float:
        """Return σ in 1/s at one value."""
        return float(self.growth(np.float64(value)))

    def rounding_at(self, value: float) -> float:
        """Return a bound of the rounding error of σ at one value, in 1/s."""
        return growth_rounding(self._find_rates, self.close(np.float64(value)).A)

    def fastest_mode(self, value: float) -> tuple[float, tuple[float, ...]]:
        """Return the frequency of the mode that grows fastest, in rad/s, and the direction in which it moves."""
        loop = self.close(np.float64(value))
        if not np.all(np.isfinite(loop.A)):
            return math.nan, ()
        found, vectors = np.linalg.eig(self.modes.reduce(loop.A))
        rates = to_rates(self.parts, found)
        i = int(np.argmax(rates.real))
        state = self.modes.right @ vectors[:, i]
        frequency = find_frequency(self.parts, loop, complex(rates[i]), state)
        return frequency, find_direction(self.parts, self.direction, state)

    def find_fixed_growth(self) -> tuple[float, float, tuple[float, ...]] | None:
        """Return σ, frequency and direction of an unstable mode that no such environment moves, or None.

        A pure drift is no instability. Its poles, of which several at one place scatter by rounding, are marginal.
        """
        fixed, sampled = self.modes.fixed, bool(self.parts.sample_time)
        near_rest = np.abs(fixed - (1.0 if sampled else 0.0)) < (1e-3 if sampled else 1.0)
        loop = self.close(np.float64(0.0))
        known = not sampled and bool(np.all(np.isfinite(loop.A)))
        size = max(1.0, float(np.max(np.abs(np.linalg.eigvals(loop.A)), initial=0.0))) if known else 1.0
        scatter = 3.0 * 1e-16 ** (1.0 / max(1, int(np.count_nonzero(near_rest)))) * size
        excess = np.abs(fixed) - 1.0 if sampled else fixed.real
        if not np.any(excess > scatter):
            return None
        pole = fixed[int(np.argmax(excess))]
        rate = to_rates(self.parts, np.array([pole]))[0]
        found, vectors = np.linalg.eig(loop.A)
        state = vectors[:, int(np.argmin(np.abs(found - pole)))]
        frequency = find_frequency(self.parts, loop, complex(rate), state)
        return float(rate.real), frequency, find_direction(self.parts, self.direction, state)

    def growth_by_control(self, value: float) -> float:
        """Return σ in 1/s from python-control's discretization and feedback of plant and controller."""
        import control

        parts, K = self.parts, self.parts.controller
        joined = join_environment(parts, self.direction, **{**self.held, self.vary: value})
        rows, T = controller_rows(parts, joined), parts.sample_time
        many = joined.B.shape[-1]
        if T:
            continuous = control.ss(joined.A, joined.B, rows.x, 0.0 * rows.now)
            over: Any = None
            for tick in parts.controllers:
                h = tick.duration
                plant = control.sample_system(continuous, h, method="zoh")
                last = control.ss(np.zeros((many, many)), np.eye(many), rows.last, rows.now, h)
                found = control.feedback(plant + last, control.ss(*tick.matrices, h), sign=1)
                over = found.A if over is None else found.A @ over
        elif np.linalg.det(np.eye(many) - K.D @ rows.now) <= 0.0:
            return math.inf
        else:
            found = control.feedback(control.ss(joined.A, joined.B, rows.x, rows.now), control.ss(*K), sign=1)
        poles = np.asarray(np.linalg.eigvals(over) if parts.ticks else found.poles())
        for fixed in self.modes.fixed:
            poles = np.delete(poles, np.argmin(np.abs(poles - fixed)))
        return float(np.max(to_rates(parts, poles).real))


def find_poles(parts: ContactParts, direction: np.ndarray, **environment: Array) -> np.ndarray:
    """Return the poles s or z of the modes that an environment can move, NaN where the loop has no solution.

    Properties of the environment may be arrays; the poles are along the last axis.
    """
    used = {"stiffness", "damping", "mass"} | ({"tool_mass"} & set(environment))
    alone = close_loop(parts, join_environment(parts, direction))
    A = close_loop(parts, join_environment(parts, direction, **environment)).A
    solvable = np.isfinite(A).all(axis=(-1, -2))[..., None]
    reduced = split_modes(parts, direction, alone, used).reduce(np.where(solvable[..., None], A, 0.0))
    return np.where(solvable, np.linalg.eigvals(reduced), np.nan)


def to_rates(parts: ContactParts, poles: np.ndarray) -> np.ndarray:
    """Return poles in 1/s: as they are, or s = ln z/T in a sampled loop."""
    if not parts.sample_time:
        return poles
    return np.asarray(np.log(np.where(np.abs(poles) < 1e-300, 1e-300, poles).astype(complex)) / parts.sample_time)


@on_one_thread
def find_limit(
    parts: ContactParts,
    direction: np.ndarray,
    vary: str,
    held: Mapping[str, float],
    grid: np.ndarray,
) -> ContactLimit:
    """Return the first value of a property at which the coupled loop loses its stability; see `Contact`.

    Raises
    ------
    ParameterError
        If a property is NaN, infinite or negative.
    ConfirmationError
        If python-control's interconnection of the same parts is not stable below the limit and unstable above it.
    """
    loop = CoupledLoop.of(parts, direction, vary, held)
    frequency, moved = math.nan, tuple[float, ...]()
    if (fixed := loop.find_fixed_growth()) is not None:
        rate, frequency, moved = fixed
        grows = f"a mode that no such environment moves grows by {rate:.4g} 1/s"
        found = FoundLimit(0.0, (), math.nan, rate, 0.0, grows)
    else:
        found = find_first_limit(
            vary,
            grid,
            loop.growth(grid),
            loop.growth_at,
            loop.growth_by_control,
            loop.rounding_at,
            partial(_model_error, loop),
        )
        if found.value < math.inf:
            frequency, moved = loop.fastest_mode(found.value or float(grid[0]))
    return ContactLimit(
        vary=vary,
        unit=UNITS[vary],
        frequency=frequency,
        direction=moved,
        scanned=(float(grid[0]), float(grid[-1])),
        environment=dict(held),
        findings=parts.findings,
        **found._asdict(),
    )


@on_one_thread
def map_growth(
    parts: ContactParts,
    direction: np.ndarray,
    x: tuple[str, np.ndarray],
    y: tuple[str, np.ndarray],
    held: Mapping[str, float],
) -> ContactMap:
    """Return the growth rates over two properties, each given by its name and its values; see `Contact`."""
    across, up = x[1], y[1]
    rows, limits = [], []
    for value in up.tolist():
        environment = {**held, y[0]: value}
        loop = CoupledLoop.of(parts, direction, x[0], environment)
        fixed = loop.find_fixed_growth()
        rows.append(np.maximum(loop.growth(across), -np.inf if fixed is None else fixed[0]))
        grid = scan_points(x[0], (float(across[0]), float(across[-1])), PER_DECADE)
        limits.append(find_limit(parts, direction, x[0], environment, grid))
    return ContactMap(x[0], y[0], across, up, np.array(rows).reshape(len(up), len(across)), tuple(limits))


def check_properties(held: Mapping[str, Any], vary: str) -> dict[str, float]:
    """Return the properties of an environment that are held, as numbers.

    Raises
    ------
    OptionError, ParameterError
        If a property is unknown, or held and varied; if its value is no finite number that is not negative.
    """
    check_property(vary, "vary")
    for name in held:
        check_property(name, str(name))
        if name == vary:
            raise OptionError(
                "found it among the held properties, too; expected it only as the one that varies. Leave it out.",
                port=name,
            )
    return {name: read_number(value, name, UNITS[name]) for name, value in held.items()}


def read_scan(vary: str, low: Any, high: Any, per_decade: Any) -> np.ndarray:
    """Return the values of a property at which its scan looks.

    Raises
    ------
    OptionError
        If the scan does not rise or is too coarse.
    """
    unit = f"value in {UNITS[vary]}"
    first, last = (
        None if end is None else read_positive(end, name, unit) for name, end in (("low", low), ("high", high))
    )
    return scan_points(vary, (first, last), read_density(per_decade, FEWEST_PER_DECADE))


def _model_error(loop: CoupledLoop, value: float) -> float:
    """Return a bound of the change of σ by the stated errors of the plant's linear model, entry by entry."""
    parts, (E, contact) = loop.parts, loop.parts.errors
    base, total = loop.growth_at(value), 0.0

    def changed(name: str, matrix: np.ndarray) -> ContactParts:
        if name in "ABCD":
            return replace(parts, plant=parts.plant._replace(**{name: matrix}))
        changes: dict[str, Any] = {name: matrix}
        return replace(parts, **changes)

    entries = {"A": E.A, "B": E.B, "C": E.C, "D": E.D}
    entries |= {"force": contact.B, "position": contact.C, "velocity": contact.D}
    for name, errors in entries.items():
        matrix = getattr(parts.plant, name) if name in "ABCD" else getattr(parts, name)
        for place in zip(*np.nonzero(errors), strict=True):
            moved = matrix.copy()
            moved[place] += _ESTIMATED * errors[place]
            total += abs(replace(loop, parts=changed(name, moved)).growth_at(value) - base)
    return total
