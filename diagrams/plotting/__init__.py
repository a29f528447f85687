"""Figures: their style, axes, layout, and whether pyplot has them."""

from .axes import AxisUnits, mark_zeros, set_degrees, set_frequencies, set_magnitudes, set_powers
from .figures import new_figure, save, shown_figure
from .layout import lay_out
from .style import (
    BLUE,
    COLORS,
    DARK,
    GREEN,
    GREY,
    LINES,
    PURPLE,
    STONE,
    VERMILION,
    WIDTH,
    legend_above,
    legend_columns,
    limit_time,
    marker_of,
    style,
)

__all__ = [
    "BLUE",
    "COLORS",
    "DARK",
    "GREEN",
    "GREY",
    "LINES",
    "PURPLE",
    "STONE",
    "VERMILION",
    "WIDTH",
    "AxisUnits",
    "lay_out",
    "legend_above",
    "legend_columns",
    "limit_time",
    "mark_zeros",
    "marker_of",
    "new_figure",
    "save",
    "set_degrees",
    "set_frequencies",
    "set_magnitudes",
    "set_powers",
    "shown_figure",
    "style",
]
