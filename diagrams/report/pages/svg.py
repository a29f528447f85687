"""Figures of a report, as SVG within a page."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

from ...drawing import Drawing
from ...plotting import lay_out

if TYPE_CHECKING:
    from markupsafe import Markup

    from .document import Plot, Section

WIDE = 900.0
"""Width in pixels above which a figure is turned by a right angle on paper."""


@dataclass(frozen=True)
class EmbeddedFigure:
    """A figure as a page holds it: SVG for the screen, and one with other ids for paper where it is turned there."""

    screen: Markup
    paper: Markup | None = None
    width: float = 0.0
    height: float = 0.0


_KEPT: WeakKeyDictionary[Any, str] = WeakKeyDictionary()
"""Drawings of figures that another process has made; each is used once, as a figure may be changed later."""


def draw_section(section: Section) -> tuple[str, ...]:
    """Return the figures of a section, and of those in it, as SVG."""
    return tuple("" if isinstance(plot.figure, Drawing) else _drawn(plot.figure) for plot in _plots(section))


def keep_drawings(section: Section, drawings: Sequence[str]) -> None:
    """Keep the drawings of `draw_section` until the section's figures are written."""
    for plot, drawing in zip(_plots(section), drawings, strict=True):
        if not isinstance(plot.figure, Drawing):
            _KEPT[plot.figure] = drawing


def _plots(section: Section) -> Iterator[Plot]:
    yield from section.plots
    for inner in section.sections:
        yield from _plots(inner)


def embedded(figure: Any, key: str, caption: str = "") -> EmbeddedFigure:
    """Return a figure as a page holds it; a wide one twice, for the screen and, to be turned, for paper.

    ``key`` begins every id in it, so that the figures of a page don't share any; ``caption`` is its text for people who
    don't see it.
    """
    if isinstance(figure, Drawing):
        from markupsafe import Markup

        return EmbeddedFigure(Markup(figure.html))
    svg = _KEPT.pop(figure, "") or _drawn(figure)
    svg = re.sub(r"<\?xml.*?\?>|<!DOCTYPE.*?>|<!--.*?-->|<metadata>.*?</metadata>", "", svg, flags=re.DOTALL).strip()
    head, rest = svg[: svg.index(">")], svg[svg.index(">") :]
    head = re.sub(r'\s(role|aria-label)="[^"]*"', "", head)
    svg = f'{head} role="img" aria-label="{escape(caption, quote=True)}"{rest}'
    found = re.search(r'<svg[^>]*?\bwidth="([\d.]+)(pt|px)?" height="([\d.]+)', svg)
    if found is None:
        return EmbeddedFigure(_own_ids(svg, key))
    factor = 4 / 3 if found[2] == "pt" else 1.0
    width, height = float(found[1]) * factor, float(found[3]) * factor
    if width <= WIDE or width < height:
        return EmbeddedFigure(_own_ids(svg, key))
    return EmbeddedFigure(_own_ids(svg, key), _own_ids(svg, f"{key}-paper"), width, height)


def _own_ids(svg: str, key: str) -> Markup:
    from markupsafe import Markup

    svg = re.sub(r'\bid="', f'id="{key}-', svg)
    svg = re.sub(r'((?:xlink:)?href=")#', rf"\1#{key}-", svg)
    return Markup(re.sub(r"url\(#", f"url(#{key}-", svg))


def _drawn(figure: Any) -> str:
    from matplotlib import rc_context

    buffer = io.StringIO()
    engine = figure.get_layout_engine()
    options: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.03} if engine is None else {}
    own: dict[Any, Any] = {"svg.fonttype": "path", "svg.hashsalt": "loopwright"}
    with rc_context({**own, "figure.autolayout": False, "figure.constrained_layout.use": False}):
        if engine is not None:  # with an engine, or a tight box, saving would go over the whole figure twice
            figure.set_layout_engine(None)
            if not lay_out(figure):
                engine.execute(figure)
        try:
            figure.savefig(buffer, format="svg", metadata={"Date": None}, **options)
        finally:
            figure.set_layout_engine(engine)
    return buffer.getvalue()
