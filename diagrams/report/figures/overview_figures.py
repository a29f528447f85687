"""Small figures for the summary: a Bode diagram and a step response stand side by side for each loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from ...plotting import WIDTH
from ..pages import Plot, Texts
from .loop_figures import DrawnLoops, draw_bode
from .step_figures import draw_answer

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ...measure import StepResponse

TEXTS = Texts(__package__, "figures")
HEIGHTS = (1.9, 1.9, 1.9, 1.7, 1.4, 1.25)
"""Heights in inches of the figures of one loop, by the number of loops: those of all have room on two pages, with the
verdicts."""
HALF = 0.5 * WIDTH


def overview_bode(key: str, of: DrawnLoops) -> Plot:
    """Draw L of a loop over frequency, with the margins marked."""
    caption = TEXTS.line("overview_bode", wire=of.wire)
    return Plot(f"overview_{key}_bode", caption, lambda: draw_bode(of, HEIGHTS[0], HALF), group=key)


def overview_step(
    key: str, said: str, curves: Mapping[str, StepResponse], looks: Mapping[str, dict[str, Any]], *, to_output: bool
) -> Plot:
    """Draw the answer to a step; ``said`` names where it begins and ends."""

    def draw() -> Figure:
        return draw_answer(curves, looks, HEIGHTS[0], HALF, to_output=to_output)

    return Plot(f"overview_{key}_step", TEXTS.line("overview_step", said=said), draw, group=key)


def fit_overview(groups: Sequence[Sequence[Plot]]) -> tuple[Plot, ...]:
    """Return the figures of all groups, `HEIGHTS` at most, as high as two pages have room for."""
    height = HEIGHTS[len(groups) - 1]
    return tuple(replace(plot, figure=partial(_resized, plot, height)) for group in groups for plot in group)


def _resized(plot: Plot, height: float) -> Figure:
    figure: Figure = plot.figure
    figure.set_size_inches(HALF, height)
    return figure
