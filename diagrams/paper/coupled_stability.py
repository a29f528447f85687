"""Coupled stability of Fig. 3's compliance loop: poles, growth rates, limits and maps.

Robot and environment, a mass m_e, a damper b_e and a spring k_e, make one closed loop. Its growth rate σ is the largest
real part of its poles, ln|z|/T in a sampled loop. It is stable if σ < 0. The loop is that of `AdmittanceLoop.contact`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

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
from ..contact import (
    PER_DECADE,
    UNITS,
    Contact,
    GrowthMap,
    check_environment,
    describe_limit,
    find_limit,
    find_poles,
    scan_points,
    to_rates,
)
from ..frequency import Number
from .compliance_loop import AdmittanceLoop

ROBOT = kinds.one_of_class(AdmittanceLoop, "an AdmittanceLoop(…), such as AdmittanceLoop.of(diagram)")
"""Kind of the first argument of functions of a robot's admittance."""


@accepts(loop=ROBOT, stiffness=kinds.numbers, damping=kinds.numbers, mass=kinds.numbers, tool_mass=kinds.numbers)
def poles(
    loop: AdmittanceLoop,
    *,
    stiffness: Array = 0.0,
    damping: Array = 0.0,
    mass: Array = 0.0,
    tool_mass: Array | None = None,
) -> Array:
    """Return the poles of the coupled loop, s in 1/s or z.

    Parameters
    ----------
    loop : AdmittanceLoop
        Robot and controller.
    stiffness, damping, mass : float or array
        Environment: k_e in N/m, b_e in N s/m, m_e in kg. Arrays are broadcast.
    tool_mass : float or array, optional
        Mass of the tool in kg, in place of the loop's own.

    Returns
    -------
    ndarray
        Poles along the last axis, without the pure drift of a coupled direction that has neither environment nor
        stiffness.
    """
    given = {"stiffness": stiffness, "damping": damping, "mass": mass, "tool_mass": tool_mass}
    contact, environment = _without_tool(loop, given)
    return find_poles(contact.parts, contact.direction, **environment)


@accepts(loop=ROBOT, environment=kinds.numbers)
def growth_rate(loop: AdmittanceLoop, **environment: Array) -> Array:
    """Return σ in 1/s: the coupled loop grows like exp(σ t), and is stable if σ < 0.

    Parameters
    ----------
    loop : AdmittanceLoop
        Robot and controller.
    **environment
        Environment, as `poles` takes it.

    Returns
    -------
    float or ndarray
        σ; infinite where the continuous equations have no solution.
    """
    rates = _rates(loop, poles(loop, **environment)).real
    sigma = np.where(np.isnan(rates).any(axis=-1), np.inf, np.max(rates, axis=-1))
    return float(sigma) if np.ndim(sigma) == 0 else sigma


@accepts(loop=ROBOT, environment=kinds.number)
def crossing_frequency(loop: AdmittanceLoop, **environment: Array) -> float:
    """Return the frequency of the pole that grows fastest, rad/s."""
    rates = _rates(loop, poles(loop, **environment))
    return float(abs(rates[np.argmax(rates.real)].imag))


def _rates(loop: AdmittanceLoop, values: np.ndarray) -> np.ndarray:
    return to_rates(loop.contact.parts, values)


def _without_tool(loop: AdmittanceLoop, given: Mapping[str, Any]) -> tuple[Contact, dict[str, Any]]:
    """Return the contact of a loop, and its environment; a perfect inner loop feels a tool as a mass."""
    environment = {name: value for name, value in given.items() if value is not None}
    if loop.implementation != "ideal":
        return loop.contact, environment
    tool = environment.pop("tool_mass", loop.tool_mass)
    check_environment(tool_mass=tool, mass=environment.get("mass"))
    mass = np.asarray(environment.pop("mass", 0.0), dtype=float) + np.asarray(tool, dtype=float)
    return loop.replace(tool_mass=0.0).contact, {**environment, "mass": mass}


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
        return describe_limit(self.over, self.value, self.unit, self.frequency, self.environment)

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
    check_environment(**environment)
    grid = scan_points(over, (low, high), per_decade)
    vary, held = over, dict(environment)
    if loop.implementation == "ideal":  # a tool is a mass: the one that is held belongs to the robot
        own = held.pop("tool_mass", loop.tool_mass)
        if over == "tool_mass":
            vary, own = "mass", held.pop("mass", 0.0)
        loop = loop.replace(tool_mass=own)
    found = find_limit(loop.contact.parts, loop.contact.direction, vary, held, grid)
    is_found = 0.0 < found.value < math.inf
    return StabilityLimit(
        over=over,
        frequency=crossing_frequency(loop, **{vary: found.value}, **held) if is_found else math.nan,
        rule_of_thumb=rule_of_thumb(loop, environment.get("damping", 0.0)) if over == "stiffness" else math.nan,
        environment=dict(environment),
        findings=loop.findings,
        value=found.value,
        unit=found.unit,
        restabilizes=found.restabilizes,
        growth_below=found.growth_below,
        growth_above=found.growth_above,
        scanned=found.scanned,
        tolerance=found.tolerance,
        confirmed_by=found.confirmed_by,
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
