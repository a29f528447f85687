"""Figures of a report, as SVG within a page."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from ..drawing.svg import draw
from ..flat.wired_diagram import WiredDiagram
from .model import Plot, Report

DRAWING = "diagram"
"""How the keys of a diagram's drawings begin; they stand ahead of the tables."""

ACROSS = 1200.0
"""Width in pixels up to which a diagram is drawn as one."""

WIDE = 900.0
"""Width in pixels above which a figure is turned by a right angle on paper."""


def embedded(figure: Any, key: str) -> str:
    """Return a figure as a page holds it; a wide one twice, for the screen and, turned, for paper.

    Parameters
    ----------
    figure : matplotlib.figure.Figure or str
        The figure, or SVG.
    key : str
        Goes ahead of every id in it, so that the figures of a page don't share any.
    """
    svg = figure if isinstance(figure, str) else _drawn(figure)
    svg = re.sub(r"<\?xml.*?\?>|<!DOCTYPE.*?>|<!--.*?-->|<metadata>.*?</metadata>", "", svg, flags=re.DOTALL).strip()
    found = re.search(r'<svg[^>]*?\bwidth="([\d.]+)(pt|px)?" height="([\d.]+)', svg)
    if found is None:
        return f'<div class="scroll">{_own_ids(svg, key)}</div>\n'
    factor = 4 / 3 if found[2] == "pt" else 1.0
    width, height = float(found[1]) * factor, float(found[3]) * factor
    if width <= WIDE or width < height:
        return f'<div class="scroll">{_own_ids(svg, key)}</div>\n'
    turned = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{height:g}" height="{width:g}" '
        f'viewBox="0 0 {height:g} {width:g}"><g transform="translate({height:g} 0) rotate(90)">'
        f"{_own_ids(svg, key + '-paper')}</g></svg>"
    )
    return f'<div class="scroll wide">{_own_ids(svg, key)}</div>\n<div class="paper">{turned}</div>\n'


def _own_ids(svg: str, key: str) -> str:
    svg = re.sub(r'\bid="', f'id="{key}-', svg)
    svg = re.sub(r'((?:xlink:)?href=")#', rf"\1#{key}-", svg)
    return re.sub(r"url\(#", f"url(#{key}-", svg)


def _drawn(figure: Any) -> str:
    from matplotlib import rc_context

    buffer = io.StringIO()
    with rc_context({"svg.fonttype": "path", "svg.hashsalt": "loopwright"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None}, bbox_inches="tight", pad_inches=0.03)
    return buffer.getvalue()


def with_drawing(report: Report, diagram: WiredDiagram) -> Report:
    """Return a report with the drawing of its diagram in its first section.

    A large one is drawn with closed boxes, and the inside of each box by itself.
    """
    if not report.sections:
        return report
    first, *others = report.sections
    plots = (*_drawings(diagram), *first.plots)
    return replace(report, sections=(replace(first, plots=plots), *others))


def _drawings(diagram: WiredDiagram) -> Iterator[Plot]:
    legend = "Boxes are subsystems with their rates; FMUs have a double border; names of wires are in italics."
    whole = draw(diagram, closed=False)
    found = re.search(r'width="([\d.]+)"', whole)
    boxes = [path for path in diagram.frames if path]
    if not boxes or (found is not None and float(found[1]) <= ACROSS):
        yield Plot(DRAWING, f"The diagram. {legend}", whole)
        return
    yield Plot(DRAWING, f"The diagram with its subsystems closed. {legend}", draw(diagram, closed=True))
    for box in boxes:
        yield Plot(f"{DRAWING}.{box}", f"The inside of the subsystem `{box}`.", draw(diagram, box=box, closed=True))
