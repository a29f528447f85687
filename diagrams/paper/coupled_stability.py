"""Coupled stability of Fig. 3's compliance loop: what `Contact` says of `AdmittanceLoop.contact`, and a rule of thumb.

Robot and environment, a mass m_e, a damper b_e and a spring k_e, make one closed loop. Its growth rate σ is the largest
real part of its poles, ln|z|/T in a sampled loop. It is stable if σ < 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ...blocks.core import Array, accepts, explain_calls, kinds
from ..contact import (
    PER_DECADE,
    ContactLimit,
    ContactMap,
    check_properties,
    check_property,
    find_limit,
    find_poles,
    scan_points,
    to_rates,
)
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
    environment = {"stiffness": stiffness, "damping": damping, "mass": mass}
    if tool_mass is not None:
        environment["tool_mass"] = tool_mass
    return find_poles(loop.contact.parts, loop.contact.direction, **environment)


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
    rates = to_rates(loop.contact.parts, poles(loop, **environment)).real
    sigma = np.where(np.isnan(rates).any(axis=-1), np.inf, np.max(rates, axis=-1))
    return float(sigma) if np.ndim(sigma) == 0 else sigma


@accepts(loop=ROBOT, environment=kinds.number)
def crossing_frequency(loop: AdmittanceLoop, **environment: Array) -> float:
    """Return the frequency of the pole that grows fastest, rad/s."""
    rates = to_rates(loop.contact.parts, poles(loop, **environment))
    return float(abs(rates[np.argmax(rates.real)].imag))


@explain_calls
@dataclass(frozen=True, repr=False)
class StabilityLimit(ContactLimit):
    """Limit of a compliance loop: a `ContactLimit` with its rule of thumb.

    Attributes
    ----------
    over : str
        Property, as ``vary``.
    rule_of_thumb : float
        (d + b_e)/T_d for a stiffness, NaN for another property; see `rule_of_thumb`.
    """

    rule_of_thumb: float = field(default=math.nan, compare=False)

    @property
    def over(self) -> str:
        """The property, as ``vary``."""
        return self.vary

    @classmethod
    def of(cls, loop: AdmittanceLoop, found: ContactLimit) -> StabilityLimit:
        """Return a limit of a loop's contact, with the loop's rule of thumb."""
        damping = found.environment.get("damping", 0.0)
        return cls(**vars(found), rule_of_thumb=rule_of_thumb(loop, damping) if found.vary == "stiffness" else math.nan)


@explain_calls
@dataclass(frozen=True, eq=False, repr=False)
class StabilityMap(ContactMap):
    """Map of a compliance loop: a `ContactMap` whose limits are each a `StabilityLimit`."""

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
def stability_limit(
    loop: AdmittanceLoop,
    over: str = "stiffness",
    *,
    low: float | None = None,
    high: float | None = None,
    per_decade: int = PER_DECADE,
    **environment: float,
) -> StabilityLimit:
    """Return the first value of ``over`` at which the coupled loop loses its stability; see `Contact.stability_limit`.

    Parameters
    ----------
    loop : AdmittanceLoop
        Robot and controller.
    over : str, optional
        ``"stiffness"``, ``"damping"`` or ``"mass"`` of the environment, or ``"tool_mass"``.
    low, high : float, optional
        Ends of the scan.
    per_decade : int, optional
        Points of the scan in a decade.
    **environment
        Other properties, as `poles` takes them.

    Raises
    ------
    OptionError, ParameterError
        If a property is unknown, negative or given twice, or the scan does not rise.
    ConfirmationError
        If python-control's interconnection of the same parts disagrees.
    """
    held = check_properties(environment, check_property(over, "over"))
    grid = scan_points(over, (low, high), per_decade)
    return StabilityLimit.of(loop, find_limit(loop.contact.parts, loop.contact.direction, over, held, grid))


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
def stability_map(
    loop: AdmittanceLoop,
    x_values: Array,
    y_values: Array,
    *,
    x: str = "stiffness",
    y: str = "damping",
    **environment: float,
) -> StabilityMap:
    """Return the growth rate over two properties, and the limit of x at each value of y; see `Contact.stability_map`.

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
    """
    found = loop.contact.stability_map(x_values, y_values, x=x, y=y, **environment)
    return StabilityMap(**{**vars(found), "limits": tuple(StabilityLimit.of(loop, limit) for limit in found.limits)})
