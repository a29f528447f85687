"""Wires that are cut ahead of some of their consumers, by a name of their own: loops there, and operating points."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from ..flat import WiredDiagram
from ..results import OperatingPoint
from ..wiring import join
from .inserted_blocks import find_inputs, name_wire_to, with_passed_values
from .operating_points import PointLike, copy_point

STEP = 1e-3
"""Communication step in s with which signals of a diagram without a clock are looked up."""


def name_of_cut(wire: str, inputs: Sequence[tuple[str, str]]) -> str:
    """Return the name of a wire ahead of some of its consumers: "u → plant.u"."""
    return f"{wire} → {', '.join(join(*to) for to in inputs)}" if inputs else wire


def cut_to(diagram: WiredDiagram, wire: str, to: str | Iterable[str]) -> tuple[WiredDiagram, str]:
    """Return the diagram in which a wire has a name ahead of some of its consumers, and that name."""
    flat = diagram.flatten(None if diagram.has_clock else STEP)
    inputs = find_inputs(diagram, flat, wire, [to] if isinstance(to, str) else to)
    name = name_of_cut(wire, inputs)
    return name_wire_to(diagram, name, inputs), name


def carry_point(diagram: WiredDiagram, point: PointLike, cut: WiredDiagram) -> PointLike:
    """Return an operating point of a diagram as one of the diagram in which wires are cut; other points as they are."""
    if not isinstance(point, OperatingPoint) or cut is diagram:
        return point
    return with_passed_values(cut, copy_point(diagram, with_passed_values(diagram, point), cut))
