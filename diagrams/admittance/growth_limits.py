"""Limits of one property of an environment: changes of sign of a coupled loop's growth rate, scanned from below.

A limit is the first value at which the sign changes. The scan also finds regions beyond it that are stable again;
bisection between two ends would miss them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from ...blocks.core import ConfirmationError, OptionError, brief
from ..frequency import refine_sign_change

SCANNED = {"stiffness": (1e-2, 1e8), "damping": (1e-3, 1e6), "mass": (1e-4, 1e4), "tool_mass": (1e-4, 1e4)}
"""Ends of the scan for each property, by default."""
UNITS = {"stiffness": "N/m", "damping": "N.s/m", "mass": "kg", "tool_mass": "kg"}
"""Unit of each property."""
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
"""Relative change of entries, how often it is tried, and the factor on the spread of what comes out."""
_SMALL = 1e-6
"""Growth rate, relative to the largest of a scan, below which its rounding is looked at."""
_MORE = 1e3
"""Multiple of the rounding at the ends of a scan within which the rounding at each point is looked at."""
Growth = Callable[[float], float]


def growth_rounding(rates: Callable[[np.ndarray], np.ndarray], A: np.ndarray) -> float:
    """Return a bound of the rounding error of a growth rate in 1/s, infinite where the matrix is not finite.

    The growth rate is computed again with every entry changed by some roundings. Its eigenvalues answer as they do to
    the rounding of any machine: one that stands alone by as much, several in one place by far more.

    Parameters
    ----------
    rates : callable
        From a stack of matrices to their growth rates.
    A : ndarray, shape (n, n)
        Matrix of the loop.
    """
    if not np.isfinite(A).all():
        return math.inf
    changes = 1.0 + _UNIT * np.random.default_rng(0).uniform(-1.0, 1.0, (_CHANGES, *A.shape))
    found = rates(np.concatenate([A[None], A * changes]))
    return float(_SAFETY * np.ptp(found))


class FoundLimit(NamedTuple):
    """A limit that a scan has found; the names are those of `StabilityLimit` and `ContactLimit`."""

    value: float
    restabilizes: tuple[float, ...]
    growth_below: float
    growth_above: float
    tolerance: float
    confirmed_by: str


class _Limit(Protocol):
    @property
    def value(self) -> float: ...
    @property
    def unit(self) -> str: ...
    @property
    def frequency(self) -> float: ...
    @property
    def environment(self) -> dict[str, float]: ...


def describe_limit(name: str, limit: _Limit) -> str:
    """Return the short text of a limit of a property."""
    held = ", ".join(f"{name} {value:g}" for name, value in limit.environment.items())
    facts = (
        f"{name} {limit.value:.6g} {limit.unit}",
        f"at {limit.frequency:.4g} rad/s" if limit.frequency == limit.frequency else "",
        held and f"with {held}",
    )
    return brief("limit of coupled stability", *facts, then=".value, .frequency, .confirmed_by")


@dataclass(frozen=True, eq=False)
class GrowthMap:
    """Growth rates over two properties of the environment.

    Attributes
    ----------
    x, y : str
        Properties.
    x_values, y_values : ndarray
        Values of the properties.
    growth : ndarray, shape (len(y_values), len(x_values))
        σ in 1/s, negative where the loop is stable.
    """

    x: str
    y: str
    x_values: np.ndarray
    y_values: np.ndarray
    growth: np.ndarray

    def __repr__(self) -> str:
        facts = f"{len(self.y_values)} × {len(self.x_values)} growth rates over {self.y} and {self.x}"
        return brief("map of coupled stability", facts, then=".growth, .limits")


def scan_points(name: str, ends: tuple[float | None, float | None], per_decade: int) -> np.ndarray:
    """Return the values of a property at which its scan looks; None stands for the usual end, see `SCANNED`.

    Raises
    ------
    OptionError
        If the ends don't rise.
    """
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

    Parameters
    ----------
    name : str
        The property.
    grid, sigma : ndarray, shape (n,)
        The points of the scan, and the growth rates there in 1/s.
    growth_at, growth_by_control : callable
        The growth rate at a value, and that of an independent computation.
    rounding_at : callable
        Bound of the growth rate's rounding error at a value, see `growth_rounding`.
    model_error : callable, optional
        Bound of the growth rate's error by that of the loop's model, at the limit.

    Returns
    -------
    FoundLimit
        Its value is 0 where the scan's start is unstable, and infinite without a limit.

    Raises
    ------
    ConfirmationError
        If the independent computation is not stable below the limit and unstable above it.
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
    error = apart / abs(slope) + _ROUNDING
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
