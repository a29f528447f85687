"""Drawings of the diagram in the first section of its report."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

from ...drawing import Facts, draw
from ...flat import WiredDiagram
from ..pages import Plot, Report, Texts

TEXTS = Texts(__package__, "figures")

ACROSS = 760.0
"""Width in pixels above which a drawing is broken into rows: that of a sheet, with texts that can be read."""

WIDEST, TALLEST = 1000.0, 700.0
"""Size in pixels up to which a diagram is drawn as one."""


def with_drawing(report: Report, diagram: WiredDiagram) -> Report:
    """Return a report with the drawing of its diagram in the section about it, or in the first one."""
    if not report.sections:
        return report
    at = next((i for i, section in enumerate(report.sections) if section.key == "subject"), 0)
    sections = list(report.sections)
    sections[at] = replace(sections[at], plots=(*_drawings(diagram), *sections[at].plots))
    return replace(report, sections=tuple(sections))


def _drawings(diagram: WiredDiagram) -> Iterator[Plot]:
    facts = Facts(diagram.checked.shapes, diagram.checked.units, {})
    drawn = partial(draw, diagram.structure, diagram.name, facts, width=ACROSS)
    whole = drawn(closed=False)
    subsystems = [path for path in diagram.subsystems if path]
    if not subsystems or (whole.size[0] <= WIDEST and whole.size[1] <= TALLEST):
        yield Plot("diagram", TEXTS.line("diagram", closed=False), whole)
        return
    yield Plot("diagram", TEXTS.line("diagram", closed=True), drawn(closed=True))
    for subsystem in subsystems:
        inside = drawn(subsystem=subsystem, closed=True)
        yield Plot(f"diagram.{subsystem}", TEXTS.line("inside", subsystem=subsystem), inside, details=True)
