"""Operating points of a diagram's variants."""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING, Any

from ._operating_point import OperatingPoint, operating_point
from ._run import Snapshot

if TYPE_CHECKING:
    from ._diagram import Diagram

STEP = Fraction(1, 1000)
"""Communication step in s at which a diagram without a clock is run to its operating point."""


def point_of(diagram: Diagram, where: Any) -> OperatingPoint:
    """Return the operating point of a variant.

    Parameters
    ----------
    diagram : Diagram
        The variant.
    where : OperatingPoint, Snapshot or float, optional
        A time to which the variant itself is run, or a point of the diagram that it is a variant of.
    """
    options: dict[str, Any] = {}
    if diagram.has_fmu and not diagram.has_clock:
        options["step"] = STEP
    if isinstance(where, OperatingPoint | Snapshot):
        where = where.t
    return operating_point(diagram, where, options)
