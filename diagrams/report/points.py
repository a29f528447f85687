"""Operating points of a diagram's variants: each runs to its own, or takes over a given one by the names of states."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Any

from ...blocks.core import OptionError
from ..flat import WiredDiagram
from ..linearization import capture, operating_point, with_passed_values
from ..results import OperatingPoint, PointOrigin, Snapshot
from ..simulation import apply_point

STEP = Fraction(1, 1000)
"""Communication step in s at which a diagram without a clock is run to its operating point."""


def point_of(diagram: WiredDiagram, where: Any, source: WiredDiagram | None = None) -> OperatingPoint:
    """Return the operating point of a variant.

    The variant is run to a time in s, or to that of a point which a run has reached. A point that was found or given is
    taken over by the names of its states; ``source`` is its diagram.
    """
    options: dict[str, Any] = {}
    if diagram.has_fmu and not diagram.has_clock:
        options["step"] = STEP
    if isinstance(where, Snapshot) or (isinstance(where, OperatingPoint) and where.how is PointOrigin.RUN):
        where = where.t
    if not isinstance(where, OperatingPoint):
        return operating_point(diagram, where, options)
    try:
        where.check_fits(diagram.flatten_like(where), diagram.name)
    except OptionError:
        return taken_over(diagram, where, diagram if source is None else source, options)
    return with_passed_values(diagram, where)


def taken_over(
    diagram: WiredDiagram, point: OperatingPoint, source: WiredDiagram, options: dict[str, Any]
) -> OperatingPoint:
    """Return a point of another diagram as one of this diagram: its FMUs', and its blocks' states by their names.

    States that only this diagram has, such as those of a delay, take the values that they settle at while all others
    are held.
    """
    from ..simulation import RunOptions, Simulation

    old = source.flatten_like(point)
    if not diagram.has_clock:
        options = {**options, "step": point.base}
    with Simulation(apply_point(diagram, point), RunOptions.of(options, block=diagram.name)) as simulation:
        simulation.take_over(point.x, old)
        return replace(capture(simulation, point.how), parameters=point.parameters)
