"""Figures of sensitivities to parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from ...plotting import BLUE, DARK, VERMILION, new_figure, style
from ..pages import Plot, Texts

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TEXTS = Texts(__package__, "figures")
LONGEST = 44
"""Letters of a parameter's path that fit next to the bars."""


def sensitivity_bars(key: str, wire: str, title: str, changes: Mapping[str, float]) -> Plot:
    """Draw the changes of a number per 1 % of each parameter as bars, the first on top."""
    names = [name if len(name) <= LONGEST else f"…{name[1 - LONGEST :]}" for name in changes]
    values = [*changes.values()]

    def draw() -> Figure:
        with style():
            figure = new_figure(0.75 + 0.22 * max(len(values), 1))
            ax = figure.add_subplot()
            ax.barh(names[::-1], values[::-1], color=[BLUE if v >= 0 else VERMILION for v in values[::-1]], height=0.6)
            ax.axvline(0.0, color=DARK, linewidth=0.6)
            ax.set_xlabel(f"change of the {title} per +1 %")
        return figure

    return Plot(key, TEXTS.line("sensitivity_bars", wire=wire, title=title), draw)
