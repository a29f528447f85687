"""Limits of coupled stability: the environments that the compliance loop can touch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from ...blocks.core import (
    Array,
    Finding,
    OptionError,
    UnknownArgumentError,
    accepts,
    explain_calls,
    kinds,
    near,
    on_one_thread,
)
from ..frequency import Number
from .compliance_loop import AdmittanceLoop
from .coupled import ROBOT, close_loop, crossing_frequency, find_rates, growth_rate, growth_rate_by_control
from .growth_limits import PER_DECADE, UNITS, GrowthMap, describe_limit, find_first_limit, growth_rounding, scan_points


@explain_calls
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
        return describe_limit(self.over, self)

    @property
    def number(self) -> Number:
        """The limit as a number of a report."""
        return Number(self.value, self.unit, self.tolerance, self.confirmed_by, findings=self.findings)


@explain_calls
@dataclass(frozen=True, eq=False, repr=False)
class StabilityMap(GrowthMap):
    """Growth rates over two properties of the environment; see `GrowthMap` for ``x``, ``y`` and ``growth``.

    Attributes
    ----------
    limits : tuple of StabilityLimit
        Limit of x at each value of y.
    """

    limits: tuple[StabilityLimit, ...]


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
    grid = scan_points(over, (low, high), per_decade)
    sigma: np.ndarray = growth_rate(loop, **{over: grid}, **environment)

    def growth_at(x: float) -> float:
        return float(growth_rate(loop, **{over: x}, **environment))

    def growth_by_control(x: float) -> float:
        return growth_rate_by_control(loop, **{over: x}, **environment)

    def rounding_at(x: float) -> float:
        return growth_rounding(partial(find_rates, loop), close_loop(loop, **{over: x}, **environment))

    found = find_first_limit(over, grid, sigma, growth_at, growth_by_control, rounding_at)
    is_found = 0.0 < found.value < math.inf
    return StabilityLimit(
        over=over,
        unit=UNITS[over],
        frequency=crossing_frequency(loop, **{over: found.value}, **environment) if is_found else math.nan,
        rule_of_thumb=rule_of_thumb(loop, environment.get("damping", 0.0)) if over == "stiffness" else math.nan,
        scanned=(float(grid[0]), float(grid[-1])),
        environment=dict(environment),
        findings=loop.findings,
        **found._asdict(),
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
            raise UnknownArgumentError(other, UNITS, block=None, found="an environment has no")
