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
Growth = Callable[[float], float]


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
    model_error: Growth = lambda _: 0.0,
) -> FoundLimit:
    """Return the first value of a property at which a loop loses its stability.

    Brent's method refines each change of sign of the growth rate; extrema between the points are looked at, too.

    Parameters
    ----------
    name : str
        The property.
    grid, sigma : ndarray, shape (n,)
        The points of the scan, and the growth rates there in 1/s.
    growth_at, growth_by_control : callable
        The growth rate at a value, and that of an independent computation.
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
    changes = tuple(_refine_change(growth_at, a, b) for a, b in find_brackets(growth_at, grid, sigma))
    if sigma[0] > 0.0:
        confirmed = f"unstable from the start of the scan, σ = {sigma[0]:.4g} 1/s"
        return FoundLimit(0.0, changes, math.nan, float(sigma[0]), 0.0, confirmed)
    if not changes:
        return FoundLimit(math.inf, (), math.nan, math.nan, 0.0, "no change of sign of the growth rate on the scan")
    value, *later = changes
    step = min(CONFIRMED_AT, 0.5 * (later[0] / value - 1.0)) if later else CONFIRMED_AT
    confirmed = _confirm(name, value, step, growth_by_control)
    slope = (growth_at((1.0 + step) * value) - growth_at((1.0 - step) * value)) / (2.0 * step)  # of σ over ln value
    error = 10.0 * abs(growth_by_control(value) / slope) + abs(model_error(value) / slope) + _ROUNDING
    below, above = (growth_at(x * value) for x in (1.0 - GROWTH_AT, 1.0 + GROWTH_AT))
    return FoundLimit(value, tuple(later), below, above, value * error, confirmed)


def _confirm(name: str, value: float, step: float, growth_by_control: Growth) -> str:
    """Confirm a limit by the poles of python-control's interconnection below and above it; return the computation."""
    below, above = (growth_by_control(x * value) for x in (1.0 - step, 1.0 + step))
    if not below < 0.0 < above:
        raise ConfirmationError(
            f"{name} {value:.6g} {UNITS[name]} is no limit: python-control's interconnection has the growth rates "
            f"{below:.4g} and {above:.4g} 1/s at {1.0 - step:.4g} and {1.0 + step:.4g} of it; expected the first "
            "negative, the second positive. Scan more finely with per_decade=…."
        )
    return f"closed-loop eigenvalues of python-control's interconnection at {1.0 - step:.4g} and {1.0 + step:.4g}"


def find_brackets(growth_at: Growth, grid: np.ndarray, sigma: np.ndarray) -> Iterator[tuple[float, float]]:
    """Yield intervals in which the growth rate changes its sign: between points, and around extrema between them."""
    from scipy.optimize import minimize_scalar

    positive = sigma > 0.0
    for i in range(len(grid) - 1):
        if positive[i] != positive[i + 1]:
            yield float(grid[i]), float(grid[i + 1])
        elif 0 < i + 1 < len(grid) - 1 and positive[i + 1] == positive[i + 2] and np.isfinite(sigma[i : i + 3]).all():
            towards = 1.0 if positive[i] else -1.0  # sign of σ that the extremum points away from
            here = towards * sigma[i : i + 3]
            if here[1] > min(here[0], here[2]) or here[1] > _FLAT * float(np.ptp(here)):
                continue
            found = minimize_scalar(
                lambda y, towards=towards: towards * growth_at(math.exp(y)),
                bounds=(math.log(grid[i]), math.log(grid[i + 2])),
                method="bounded",
                options={"xatol": 1e-10},
            )
            if float(found.fun) < 0.0:
                top = math.exp(float(found.x))
                yield float(grid[i]), top
                yield top, float(grid[i + 2])


def _refine_change(growth_at: Growth, low: float, high: float) -> float:
    """Return the value at which the growth rate changes its sign, by Brent's method."""
    from scipy.optimize import brentq

    def bound_growth(y: float) -> float:
        return min(max(growth_at(math.exp(y)), -1e6), 1e6)  # infinite where the equations have no solution

    return math.exp(float(brentq(bound_growth, math.log(low), math.log(high), xtol=1e-13, rtol=1e-13, maxiter=200)))
