"""Limits of coupled stability: the environments that the compliance loop can touch.

A limit is the first value, on a scan from below, at which the growth rate of the coupled loop changes its sign. The
scan also finds regions beyond it that are stable again; bisection between two ends would miss them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...blocks.core import Array, ConfirmationError, Finding, OptionError, accepts, brief, kinds, near, on_one_thread
from ..frequency import Number
from .compliance_loop import AdmittanceLoop
from .coupled import ROBOT, crossing_frequency, growth_rate, growth_rate_by_control

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


@dataclass(frozen=True)
class StabilityLimit:
    """First value of one property of the environment at which the coupled loop loses its stability.

    Attributes
    ----------
    over : str
        Property: ``"stiffness"``, ``"damping"``, ``"mass"`` or ``"tool_mass"``.
    value : float
        Limit; infinite if the loop is stable over the whole scan, 0 if it is unstable at its start.
    unit : str
        Unit of the limit.
    frequency : float
        Frequency in rad/s at which the loop oscillates at the limit; NaN without a limit.
    restabilizes : tuple of float
        Values beyond the limit at which the loop becomes stable again, then unstable, in turn.
    growth_below, growth_above : float
        Growth rate σ in 1/s at 0.97 and at 1.03 of the limit.
    rule_of_thumb : float
        (d + b_e)/T_d for a stiffness, NaN for another property; see `rule_of_thumb`.
    scanned : tuple of float
        Ends of the scan.
    tolerance : float
        Bound of the value's numerical error, in its unit: ten times the deviation of the confirming computation.
    confirmed_by : str
        Independent computation that agrees.
    environment : dict
        Properties that were held.
    findings : tuple of Finding
        Kinks and stairs of the diagram that the loop leaves out.
    """

    over: str
    value: float
    unit: str
    frequency: float
    restabilizes: tuple[float, ...]
    growth_below: float
    growth_above: float
    rule_of_thumb: float
    scanned: tuple[float, float]
    tolerance: float
    confirmed_by: str
    environment: dict[str, float] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()

    def __repr__(self) -> str:
        held = ", ".join(f"{name} {value:g}" for name, value in self.environment.items())
        limit = f"{self.over} {self.value:.6g} {self.unit}"
        facts = (
            limit,
            f"at {self.frequency:.4g} rad/s" if self.frequency == self.frequency else "",
            held and f"with {held}",
        )
        return brief("limit of coupled stability", *facts, then=".value, .frequency, .confirmed_by")

    @property
    def number(self) -> Number:
        """The limit as a number of a report."""
        return Number(self.value, self.unit, self.tolerance, self.confirmed_by, findings=self.findings)


@dataclass(frozen=True, eq=False)
class StabilityMap:
    """Growth rates over two properties of the environment.

    Attributes
    ----------
    x, y : str
        Properties.
    x_values, y_values : ndarray
        Values of the properties.
    growth : ndarray, shape (len(y_values), len(x_values))
        σ in 1/s, negative where the loop is stable.
    limits : tuple of StabilityLimit
        Limit of x at each value of y.
    """

    x: str
    y: str
    x_values: np.ndarray
    y_values: np.ndarray
    growth: np.ndarray
    limits: tuple[StabilityLimit, ...]

    def __repr__(self) -> str:
        facts = f"{len(self.y_values)} × {len(self.x_values)} growth rates over {self.y} and {self.x}"
        return brief("map of coupled stability", facts, then=".growth, .limits")


@accepts(loop=ROBOT, damping=kinds.number)
def rule_of_thumb(loop: AdmittanceLoop, damping: float = 0.0) -> float:
    """Return the rule of thumb for the largest stiffness, k_e ≈ (d + b_e)/T_d, in N/m.

    A held force comes late by T_d = T/2, and by T more for each sample of delay. d is the admittance's damping for
    velocities in m/s, divided by q along the path. The rule gives infinity for a loop that is not sampled.
    """
    if loop.implementation != "sampled":
        return math.inf
    d = float(loop.admittance.effective_damping) / loop.scale
    return (d + damping) / (loop.sample_time * (0.5 + loop.delay))


@accepts(
    loop=ROBOT, over=kinds.text, low=kinds.number, high=kinds.number, per_decade=kinds.whole, environment=kinds.real
)
@on_one_thread
def stability_limit(
    loop: AdmittanceLoop,
    over: str = "stiffness",
    *,
    low: float | None = None,
    high: float | None = None,
    per_decade: int = PER_DECADE,
    **environment: float,
) -> StabilityLimit:
    """Return the first value of ``over`` at which the coupled loop loses its stability.

    The growth rate is scanned from ``low`` to ``high``, extrema between the points included. Brent's method refines
    each change of its sign.

    Parameters
    ----------
    loop : AdmittanceLoop
        Robot and controller.
    over : str, optional
        ``"stiffness"``, ``"damping"`` or ``"mass"`` of the environment, or ``"tool_mass"``.
    low, high : float, optional
        Ends of the scan; by default those of `SCANNED`.
    per_decade : int, optional
        Points of the scan in a decade.
    **environment
        Other properties, as `poles` takes them.

    Raises
    ------
    OptionError
        If a property is unknown, ``over`` is among the held ones, or the scan does not rise.
    ParameterError
        If a property is NaN, infinite or negative.
    ConfirmationError
        If python-control's interconnection of the same parts is not stable below the limit and unstable above it.
    """
    _check(over, environment)
    first, last = SCANNED[over]
    first, last = first if low is None else low, last if high is None else high
    if not 0.0 < first < last < math.inf:
        raise OptionError(
            f"found a scan from {first!r} to {last!r}; expected 0 < low < high. Give other ends.", port=over
        )
    grid = np.geomspace(first, last, max(8, math.ceil(per_decade * math.log10(last / first)) + 1))
    sigma: np.ndarray = growth_rate(loop, **{over: grid}, **environment)
    rule = rule_of_thumb(loop, environment.get("damping", 0.0)) if over == "stiffness" else math.nan
    common: dict[str, Any] = {"over": over, "unit": UNITS[over], "rule_of_thumb": rule, "scanned": (first, last)}
    common |= {"environment": dict(environment), "findings": loop.findings}

    def growth_at(x: float) -> float:
        return float(growth_rate(loop, **{over: x}, **environment))

    changes = [refine_change(growth_at, a, b) for a, b in find_brackets(growth_at, grid, sigma)]
    if sigma[0] > 0.0:
        changes.insert(0, 0.0)
    if not changes:
        confirmed = "no change of sign of the growth rate on the scan"
        rates: dict[str, Any] = {"growth_below": math.nan, "growth_above": math.nan, "frequency": math.nan}
        return StabilityLimit(value=math.inf, restabilizes=(), tolerance=0.0, confirmed_by=confirmed, **rates, **common)
    value, *later = changes
    if value == 0.0:
        confirmed = f"unstable from the start of the scan, σ = {sigma[0]:.4g} 1/s"
        rates = {"growth_below": math.nan, "growth_above": float(sigma[0]), "frequency": math.nan}
        return StabilityLimit(
            value=0.0, restabilizes=tuple(later), tolerance=0.0, confirmed_by=confirmed, **rates, **common
        )
    step = min(CONFIRMED_AT, 0.5 * (later[0] / value - 1.0)) if later else CONFIRMED_AT
    confirmed = _confirm(loop, over, value, step, environment)
    slope = (growth_at((1.0 + step) * value) - growth_at((1.0 - step) * value)) / (2.0 * step)  # of σ over ln value
    error = abs(growth_rate_by_control(loop, **{over: value}, **environment) / slope)
    return StabilityLimit(
        value=value,
        frequency=crossing_frequency(loop, **{over: value}, **environment),
        restabilizes=tuple(later),
        growth_below=growth_at((1.0 - GROWTH_AT) * value),
        growth_above=growth_at((1.0 + GROWTH_AT) * value),
        tolerance=value * (10.0 * error + _ROUNDING),
        confirmed_by=confirmed,
        **common,
    )


@accepts(loop=ROBOT, dampings=kinds.row)
def stiffness_limits(loop: AdmittanceLoop, dampings: Sequence[float] = (0.0, 10.0, 100.0)) -> dict[str, StabilityLimit]:
    """Return the limits of the environment's stiffness: of the continuous loop, and sampled without and with a delay.

    The loop keeps its friction. For a diagram with friction, `AdmittanceLoop.of` therefore gives the numbers that a
    report calls ``ke_limit_friction``; its ``ke_limit`` is that of the design without friction.

    Parameters
    ----------
    loop : AdmittanceLoop
        Robot and controller; the implementation and delay are replaced.
    dampings : sequence of float, optional
        Dampings b_e of the environment, N s/m.

    Returns
    -------
    dict
        Limits by their names in a report, such as ``admittance.perp.ke_limit.sampled_d0.be_10``.
    """
    variants = {"continuous": loop.replace(implementation="continuous", delay=0)}
    variants |= {f"sampled_d{n}": loop.replace(implementation="sampled", delay=n) for n in (0, 1)}
    return {
        f"admittance.{loop.side}.ke_limit.{name}.be_{b:g}": stability_limit(variant, damping=b)
        for name, variant in variants.items()
        for b in dampings
    }


@accepts(loop=ROBOT, x_values=kinds.numbers, y_values=kinds.numbers, x=kinds.text, y=kinds.text, environment=kinds.real)
@on_one_thread
def stability_map(
    loop: AdmittanceLoop,
    x_values: Array,
    y_values: Array,
    *,
    x: str = "stiffness",
    y: str = "damping",
    **environment: float,
) -> StabilityMap:
    """Return the growth rate over two properties of the environment, and the limit of x at each value of y.

    Parameters
    ----------
    loop : AdmittanceLoop
        Robot and controller.
    x_values, y_values : array
        Values of the two properties; those of x positive and rising.
    x, y : str, optional
        Properties.
    **environment
        Other properties, as `poles` takes them.

    Raises
    ------
    OptionError
        If a property is unknown or given twice, or values are not a row.
    ConfirmationError
        If python-control's interconnection of the same parts disagrees with a limit.
    """
    _check(x, environment)
    _check(y, environment)
    across, up = np.asarray(x_values, dtype=float), np.asarray(y_values, dtype=float)
    if x == y or across.ndim != 1 or up.ndim != 1:
        raise OptionError(
            f"found {x!r} and {y!r} with values of {across.ndim} and {up.ndim} axes; expected two different "
            "properties, each with a row of values. Give x=…, y=….",
            port=x,
        )
    growth: np.ndarray = growth_rate(loop, **{x: across[None, :], y: up[:, None]}, **environment)
    low, high = float(across[0]), float(across[-1])
    held = [{y: float(v), **environment} for v in up]
    limits = tuple(stability_limit(loop, x, low=low, high=high, per_decade=PER_DECADE, **h) for h in held)
    return StabilityMap(x, y, across, up, growth, limits)


def _check(name: str, environment: dict[str, float]) -> None:
    """Refuse properties that are unknown, and one that is held and scanned."""
    if name not in UNITS:
        raise OptionError(f"an environment has no {name!r}. {near(name, UNITS)}", port=str(name))
    if name in environment:
        raise OptionError(
            f"found it among the held properties, as {environment[name]!r}; expected it only as the scanned one. Leave "
            "it out.",
            port=name,
        )
    for other in environment:
        if other not in UNITS:
            raise OptionError(f"an environment has no {other!r}. {near(other, UNITS)}", port=other)


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


def refine_change(growth_at: Growth, low: float, high: float) -> float:
    """Return the value at which the growth rate changes its sign, by Brent's method."""
    from scipy.optimize import brentq

    def bound_growth(y: float) -> float:
        return min(max(growth_at(math.exp(y)), -1e6), 1e6)  # infinite where the equations have no solution

    return math.exp(float(brentq(bound_growth, math.log(low), math.log(high), xtol=1e-13, rtol=1e-13, maxiter=200)))


def _confirm(loop: AdmittanceLoop, over: str, value: float, step: float, environment: dict[str, float]) -> str:
    """Confirm a limit by the poles of python-control's interconnection below and above it; return the computation."""
    below, above = (growth_rate_by_control(loop, **{over: x * value}, **environment) for x in (1.0 - step, 1.0 + step))
    if not below < 0.0 < above:
        raise ConfirmationError(
            f"{over} {value:.6g} {UNITS[over]} is no limit: python-control's interconnection has the growth rates "
            f"{below:.4g} and {above:.4g} 1/s at {1.0 - step:.4g} and {1.0 + step:.4g} of it; expected the first "
            "negative, the second positive. Scan more finely with per_decade=…."
        )
    return f"closed-loop eigenvalues of python-control's interconnection at {1.0 - step:.4g} and {1.0 + step:.4g}"
