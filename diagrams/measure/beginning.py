"""The instant at which a measurement begins: an operating point whose states a run starts in, or a time to run to."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np

from ...blocks.core import FmuError, OptionError
from ..flat import WiredDiagram
from ..results import OperatingPoint, PointOrigin
from ..simulation import Simulation, apply_point

AGAIN = 1e-3
"""Largest deviation of a repeated run from its operating point, relative to 1 + the size of a state or an output."""


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
