"""Limits of coupled stability: changes of sign of a loop's growth rate over one property of its environment.

A limit is the first value at which the sign changes. The scan also finds regions beyond it that are stable again;
bisection between two ends would miss them. Extrema of the growth rate between the points are looked at, too; Brent's
method refines each change of its sign.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ...blocks.core import (
    Array,
    ConfirmationError,
    Finding,
    OptionError,
    accepts,
    brief,
    explain_calls,
    kinds,
    on_one_thread,
)
from ..frequency import Number, refine_sign_change
from .admittance import look_again
from .contact_loop import (
    ClosedLoop,
    Modes,
    close_loop,
    controller_rows,
    find_direction,
    find_frequency,
    join_environment,
    split_modes,
)
from .coupled_parts import ContactParts
from .environment import UNITS, points_in_a_decade

SCANNED = {"stiffness": (1e-2, 1e8), "damping": (1e-3, 1e6), "mass": (1e-4, 1e4), "tool_mass": (1e-4, 1e4)}
"""Ends of the scan for each property, by default."""
PER_DECADE = 40
"""Points of a scan in a decade, by default."""
CONFIRMED_AT = 0.01
"""Relative distance from a limit at which it is confirmed: 0.99 and 1.01."""
GROWTH_AT = 0.03
"""Relative distance from a limit at which growth rates are given: 0.97 and 1.03."""
_FLAT = 20.0
"""Ratio of distance from zero and depth beyond which an extremum does not reach zero."""
_ROUNDING = 1e-12
"""Relative rounding error of Brent's method."""
_UNIT, _CHANGES, _SAFETY = 2e-15, 4, 10.0
"""Relative change of an entry, or of the largest next to it, how often it is tried, and the factor on the spread."""
_SMALL = 1e-6
"""Growth rate, relative to the largest of a scan, below which its rounding is looked at."""
_MORE = 1e3
"""Multiple of the rounding at the ends of a scan within which the rounding at each point is looked at."""
Growth = Callable[[float], float]


def growth_rounding(modes: Modes, rates: Callable[[np.ndarray], np.ndarray], A: np.ndarray) -> float:
    """Return a bound of the rounding error of a growth rate in 1/s, infinite where the matrix is not finite.

    The growth rate is computed again with every entry of the matrix changed by some roundings. Where the fixed modes
    are split off, every entry, zeros too, is changed by some roundings of the largest one next to it, as LAPACK's
    transformations do. The eigenvalues answer as they do to the rounding of any machine: one that is alone by as
    much, several in one place by far more.
    """
    if not np.isfinite(A).all():
        return math.inf
    draws, reduced = np.random.default_rng(0), modes.reduce(A)
    changed = modes.reduce(A * (1.0 + _UNIT * draws.uniform(-1.0, 1.0, (_CHANGES, *A.shape))))
    changed += _UNIT * draws.uniform(-1.0, 1.0, changed.shape) * _sizes_around(reduced)
    return float(_SAFETY * np.ptp(rates(np.concatenate([reduced[None], changed]))))


def _sizes_around(A: np.ndarray) -> np.ndarray:
    """Return the largest entry in each one's row or column, whichever is less, of the balanced matrix."""
    from scipy.linalg.lapack import dgebal

    balanced, _, _, scale, _ = dgebal(A, scale=1, permute=0)
    sizes = np.abs(balanced)
    least = np.minimum(sizes.max(axis=1, initial=0.0)[:, None], sizes.max(axis=0, initial=0.0))
    return np.asarray(least * scale[:, None] / scale)


class FoundLimit(NamedTuple):
    """A limit that a scan has found; the names are those of `ContactLimit`."""

    value: float
    restabilizes: tuple[float, ...]
    growth_below: float
    growth_above: float
    tolerance: float
    confirmed_by: str


def scan_points(name: str, ends: tuple[float | None, float | None], per_decade: int) -> np.ndarray:
    """Return the values of a property at which its scan looks; None is the usual end, see `SCANNED`."""
    first, last = (usual if end is None else end for usual, end in zip(SCANNED[name], ends, strict=True))
    if not 0.0 < first < last < math.inf:
        raise OptionError(
            f"found a scan from {first!r} to {last!r}; expected 0 < low < high. Give other ends.", port=name
        )
    return np.geomspace(first, last, max(8, math.ceil(per_decade * math.log10(last / first)) + 1))


def find_first_limit(
    name: str,
    grid: np.ndarray,
    sigma: np.ndarray,
    growth_at: Growth,
    growth_by_control: Growth,
    rounding_at: Growth,
    model_error: Growth = lambda _: 0.0,
) -> FoundLimit:
    """Return the first value of a property at which a loop loses its stability.

    Brent's method refines each change of sign of the growth rate; extrema between the points are looked at, too. A
    growth rate that is 0 but for its rounding, such as that of an undamped motion, is not unstable.

    ``growth_by_control`` is that of an independent computation, ``model_error`` the bound of the growth rate's error by
    that of the loop's model. The limit is 0 where the scan's start is unstable, and infinite without one.
    """
    scan = GrowthScan(grid, sigma, growth_at, rounding_at)
    changes = tuple(_refine_change(growth_at, *bracket) for bracket in scan.find_brackets())
    if scan.grows[0]:
        confirmed = f"unstable from the start of the scan, σ = {sigma[0]:.4g} 1/s"
        return FoundLimit(0.0, changes, math.nan, float(sigma[0]), 0.0, confirmed)
    if not changes:
        confirmed = "no change of sign of the growth rate on the scan"
        if undamped := int(np.count_nonzero(scan.rests)):
            confirmed += f"; at {undamped} of its {len(grid)} values the motion does not decay, either"
        return FoundLimit(math.inf, (), math.nan, math.nan, 0.0, confirmed)
    value, *later = changes
    step = min(CONFIRMED_AT, 0.5 * (later[0] / value - 1.0)) if later else CONFIRMED_AT
    confirmed = _confirm(name, value, step, growth_by_control, rounding_at)
    slope = (growth_at((1.0 + step) * value) - growth_at((1.0 - step) * value)) / (2.0 * step)  # of σ over ln value
    apart = 10.0 * abs(growth_by_control(value)) + abs(model_error(value)) + rounding_at(value)
    error = apart / abs(slope) + _ROUNDING if slope else math.inf
    below, above = (growth_at(x * value) for x in (1.0 - GROWTH_AT, 1.0 + GROWTH_AT))
    return FoundLimit(value, tuple(later), below, above, value * error, confirmed)


def _confirm(name: str, value: float, step: float, growth_by_control: Growth, rounding_at: Growth) -> str:
    """Confirm a limit by the poles of python-control's interconnection below and above it; return the computation."""
    below, above = (growth_by_control(x * value) for x in (1.0 - step, 1.0 + step))
    if not below <= rounding_at((1.0 - step) * value) or not above > 0.0:
        raise ConfirmationError(
            f"{name} {value:.6g} {UNITS[name]} is no limit: python-control's interconnection has the growth rates "
            f"{below:.4g} and {above:.4g} 1/s at {1.0 - step:.4g} and {1.0 + step:.4g} of it; expected the first "
            "negative, the second positive. Scan more finely with per_decade=…."
        )
    return f"closed-loop eigenvalues of python-control's interconnection at {1.0 - step:.4g} and {1.0 + step:.4g}"


class GrowthScan:
    """Growth rates on a grid, each known with its rounding where that decides whether the loop grows."""

    def __init__(self, grid: np.ndarray, sigma: np.ndarray, growth_at: Growth, rounding_at: Growth):
        self.grid, self.growth_at, self.rounding_at = grid, growth_at, rounding_at
        # a stack of matrices and a single one may round differently: rates near 0 are computed as Brent's method does
        self.sigma, self.rounding = np.array(sigma, dtype=float), np.zeros(len(grid))
        ends = [rounding_at(float(x)) for x in (grid[0], grid[-1])]
        least = max(
            _SMALL * float(np.abs(self.sigma[np.isfinite(self.sigma)]).max(initial=0.0)),
            _MORE * max((r for r in ends if r < math.inf), default=0.0),
        )
        for i in np.flatnonzero(np.abs(self.sigma) <= least).tolist():
            self.sigma[i], self.rounding[i] = growth_at(float(grid[i])), rounding_at(float(grid[i]))
        self.rests = np.abs(self.sigma) <= self.rounding
        self.grows = (self.sigma > 0.0) & ~self.rests
        self.decays = ~self.rests & ~self.grows

    def find_brackets(self) -> Iterator[tuple[float, float, float]]:
        """Yield intervals at whose ends the loop grows and doesn't, and the growth rate from which it grows.

        They lie between points, and around extrema between them.
        """
        from scipy.optimize import minimize_scalar

        grid, sigma, grows = self.grid, self.sigma, self.grows
        for i in range(len(grid) - 1):
            if grows[i] != grows[i + 1]:
                yield self._bracket(i, rising=bool(grows[i + 1]))
            elif 0 < i + 1 < len(grid) - 1 and grows[i + 1] == grows[i + 2] and np.isfinite(sigma[i : i + 3]).all():
                towards = 1.0 if grows[i] else -1.0  # sign of σ that the extremum points away from
                here = towards * sigma[i : i + 3]
                if here[1] > min(here[0], here[2]) or here[1] > _FLAT * float(np.ptp(here)):
                    continue
                found = minimize_scalar(
                    lambda y, towards=towards: towards * self.growth_at(math.exp(y)),
                    bounds=(math.log(grid[i]), math.log(grid[i + 2])),
                    method="bounded",
                    options={"xatol": 1e-10},
                )
                top = math.exp(float(found.x))
                if float(found.fun) < -self.rounding_at(top):
                    level = float(max(self.rounding[i], self.rounding[i + 2])) if self.rests[i : i + 3].any() else 0.0
                    yield float(grid[i]), top, level
                    yield top, float(grid[i + 2]), level

    def _bracket(self, i: int, rising: bool) -> tuple[float, float, float]:
        """Return the interval around a change between the points i and i + 1.

        A growth rate that leaves 0 after being 0 at several points is refined at its rounding, one that passes through
        0 at a point of the grid at 0.
        """
        rest, beyond = (i, i - 1) if rising else (i + 1, i + 2)
        low, high, level = i, i + 1, 0.0
        if self.rests[rest]:
            if 0 <= beyond < len(self.grid) and self.decays[beyond]:
                low, high = (beyond, high) if rising else (low, beyond)
            else:
                level = float(self.rounding[rest])
        return float(self.grid[low]), float(self.grid[high]), level


def _refine_change(growth_at: Growth, low: float, high: float, level: float) -> float:
    """Return the value at which the growth rate passes a level, by Brent's method."""

    def above(y: float) -> float:
        # infinite where the equations have no solution
        return min(max(growth_at(math.exp(y)) - level, -1e6), 1e6)

    return math.exp(refine_sign_change(above, math.log(low), math.log(high), xtol=1e-13, rtol=1e-13))


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
        Stiffness in N/m of a spring alone, from the admittance: ω/|Y| where Re Y(jω) = 0, near the limit's frequency.
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
    second_look: float = field(default=math.nan, compare=False)

    def __repr__(self) -> str:
        held = ", ".join(f"{held} {value:g}" for held, value in self.environment.items())
        facts = (
            f"{self.vary} {self.value:.6g} {self.unit}",
            f"at {self.frequency:.4g} rad/s" if math.isfinite(self.frequency) else "",
            held and f"with {held}",
        )
        return brief("limit of coupled stability", *facts, then=".value, .frequency, .confirmed_by")

    @property
    def number(self) -> Number:
        """The limit as a number of a report."""
        return Number(self.value, self.unit, self.tolerance, self.confirmed_by, findings=self.findings)


@explain_calls
@dataclass(frozen=True, eq=False, repr=False)
class ContactMap:
    """Growth rates over two properties of the environment.

    The growth rates are those of the modes that the environment can move, and of those that grow whatever it is.

    Attributes
    ----------
    x, y : str
        Properties.
    x_values, y_values : ndarray
        Values of the properties.
    growth : ndarray, shape (len(y_values), len(x_values))
        σ in 1/s, negative where the loop is stable, −∞ where the environment moves no mode.
    limits : tuple of ContactLimit
        Limit of x at each value of y.
    """

    x: str
    y: str
    x_values: np.ndarray
    y_values: np.ndarray
    growth: np.ndarray
    limits: tuple[ContactLimit, ...]

    def __repr__(self) -> str:
        facts = f"{len(self.y_values)} × {len(self.x_values)} growth rates over {self.y} and {self.x}"
        return brief("map of coupled stability", facts, then=".growth, .limits")


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
        """Return σ in 1/s of the fastest mode that the environment can move, −∞ where it moves none, ∞ unsolvable."""
        return self._find_rates(self.close(value).A)

    def _find_rates(self, A: np.ndarray) -> np.ndarray:
        solvable = np.isfinite(A).all(axis=(-1, -2))
        reduced = self.modes.reduce(np.where(solvable[..., None, None], A, 0.0))
        return np.where(solvable, self._rates_of(reduced), np.inf)

    def _rates_of(self, reduced: np.ndarray) -> np.ndarray:
        rates = to_rates(self.parts, np.linalg.eigvals(reduced)).real
        return np.asarray(np.max(rates, axis=-1, initial=-np.inf))

    def growth_at(self, value: float) -> float:
        """Return σ in 1/s at one value."""
        return float(self.growth(np.float64(value)))

    def rounding_at(self, value: float) -> float:
        """Return a bound of the rounding error of σ at one value, in 1/s."""
        return growth_rounding(self.modes, self._rates_of, self.close(np.float64(value)).A)

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

        A pure drift is no instability, see `Modes`.
        """
        fixed = self.modes.fixed[self.modes.growing]
        if not len(fixed):
            return None
        pole = fixed[int(np.argmax(np.abs(fixed) if self.parts.sample_time else fixed.real))]
        loop = self.close(np.float64(0.0))
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
    """Return the first value of a property at which the coupled loop loses its stability; see `Contact`."""
    loop = CoupledLoop.of(parts, direction, vary, held)
    frequency, moved, second = math.nan, tuple[float, ...](), math.nan
    # A mode that grows without the environment is no limit of it: then no value is stable, and nothing is scanned.
    if (fixed := loop.find_fixed_growth()) is not None:
        rate, frequency, moved = fixed
        grows = f"a mode that no such environment moves grows by {rate:.4g} 1/s"
        found = FoundLimit(0.0, (), math.nan, rate, 0.0, grows)
    elif not loop.modes.right.shape[1]:
        found = FoundLimit(math.inf, (), math.nan, math.nan, 0.0, "no mode of the loop is moved by such an environment")
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
        # A spring alone has a second way that shares nothing with the first: the frequency response at the contact.
        alone = vary == "stiffness" and not any(held.values()) and "tool_mass" not in held
        if alone and 0.0 < found.value < math.inf:
            second = look_again(parts, direction, frequency)
    return ContactLimit(
        vary=vary,
        unit=UNITS[vary],
        frequency=frequency,
        direction=moved,
        scanned=(float(grid[0]), float(grid[-1])),
        environment=dict(held),
        findings=parts.findings,
        second_look=second,
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


@accepts(None, low=kinds.positive, high=kinds.positive, per_decade=points_in_a_decade(FEWEST_PER_DECADE))
def read_scan(
    vary: str, low: float | None = None, high: float | None = None, per_decade: int = PER_DECADE
) -> np.ndarray:
    """Return the values of a property at which its scan looks."""
    first, last = (None if end is None else float(end) for end in (low, high))
    return scan_points(vary, (first, last), int(per_decade))


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
