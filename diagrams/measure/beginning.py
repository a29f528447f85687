"""The instant at which a measurement begins: an operating point whose states a run starts in, or a time to run to."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from types import MappingProxyType
from typing import Any

import numpy as np

from ...blocks.core import FmuError, OptionError
from ..flat import WiredDiagram
from ..linearization import RUN_OPTIONS, PointLike, operating_point
from ..results import OperatingPoint, PointOrigin, Snapshot
from ..simulation import Simulation, apply_point
from ..wiring import exact_time

AGAIN = 1e-3
"""Largest deviation of a repeated run from its operating point, relative to 1 + the size of a state or an output."""
EXACT = MappingProxyType({"rtol": 1e-9, "atol": 1e-12})
"""Tolerances of a solver."""


def divide_time(t: Fraction, longest: Fraction) -> Fraction:
    """Return the longest step between ticks, of at most ``longest`` seconds, that has a tick at time t in s."""
    return t / math.ceil(t / longest) if t else longest


def with_ticks(point: OperatingPoint, longest: Fraction) -> OperatingPoint:
    """Return the operating point of a diagram without sampling, with ticks of at most ``longest`` seconds."""
    t = point.tick * point.base
    base = divide_time(t, longest)
    return replace(point, base=base, tick=int(t / base))


def has_transport_delay(diagram: WiredDiagram) -> bool:
    """Return whether a diagram has delays in continuous time, whose past no operating point holds."""
    table = diagram.scheduled
    return any(block.transport and path not in diagram.checked.traced for path, block in table.blocks.items())


def can_start_at(diagram: WiredDiagram, point: OperatingPoint) -> bool:
    """Return whether a run can start in the states of an operating point; if not, it has to run there."""
    if point.how is not PointOrigin.RUN:
        return True
    if point.unjudged or has_transport_delay(diagram):  # FMUs that list no states, and the past of delays
        return False
    try:
        apply_point(diagram, point)
    except FmuError:
        return False
    return True


def find_beginning(
    diagram: WiredDiagram, at: PointLike, options: dict[str, Any]
) -> tuple[dict[str, Any], OperatingPoint | None, float]:
    """Return the options of the run and its beginning: an operating point to start from, or None and a time in s."""
    if isinstance(at, Snapshot):
        recipe = dict(getattr(at.run, "recipe", {}) or {})
        options = {**recipe, **options}
        if "start" not in options:
            return options, None, at.t
    if isinstance(at, OperatingPoint) and at.how == PointOrigin.RUN and "start" not in options:
        return {**options, "step": options.get("step") or at.base}, None, at.t
    if at is None or (isinstance(at, int | float) and not isinstance(at, bool) and "start" not in options):
        return options, None, float(at or 0.0)
    point = operating_point(diagram, at, options)
    options.pop("start", None)
    if not diagram.has_clock and options.get("step") is None and diagram.has_fmu:
        options["step"] = point.base
    return options, point, point.t


def find_continuous_beginning(
    diagram: WiredDiagram, at: PointLike, options: dict[str, Any], longest: Fraction
) -> tuple[dict[str, Any], OperatingPoint | None, float]:
    """Return what `find_beginning` does, for a diagram without sampling: ticks of any length have its point's time.

    They are ``step`` apart, where that is among the options, or else ``longest``, or less so that one is at the point.
    """
    if isinstance(at, Snapshot):
        recipe = getattr(at.run, "recipe", {}) or {}
        options = {**{name: value for name, value in recipe.items() if name != "step"}, **options}
    if options.get("step") is not None:
        longest = exact_time(options["step"], block=diagram.name)
    is_start = at is None or (isinstance(at, OperatingPoint) and at.how == PointOrigin.RUN and at.t == 0.0)
    if "start" not in options and (is_start or (isinstance(at, int | float) and at == 0.0)):
        return {**options, "step": longest}, None, 0.0
    run = {name: value for name, value in options.items() if name in RUN_OPTIONS and name != "step"}
    point = with_ticks(operating_point(diagram, at, {**EXACT, **run}), longest)
    options.pop("start", None)
    return {**options, "step": point.base}, point, point.t


def check_reached(simulation: Simulation, point: OperatingPoint) -> None:
    """Refuse a repeated run that is not at its operating point: that was reached from another start."""
    off = 0.0
    for found, expected in ((simulation.view.x, point.x), (simulation.view.w, point.w)):
        off = max(off, float(np.max(np.abs(found - expected) / (1.0 + np.abs(expected)), initial=0.0)))
    if not off <= AGAIN:
        raise OptionError(
            f"found a state off by {off:.3g} after a run from the start to t = {point.t:g} s; expected the operating "
            f"point, to {AGAIN:g}. It was reached from another start, and its FMUs can't start there. Give a time in "
            "s: at=….",
            block=simulation.wired.name,
            port="at",
            t=point.t,
        )
