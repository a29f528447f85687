"""The style of all figures: colors, sizes, legends."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette, which colour-blind readers tell apart
BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9"
GREY, STONE, DARK = "#A6A6A6", "#6E6E6E", "#333333"
"""Helping lines; curves and texts in the background; texts."""

COLORS = (BLUE, VERMILION, GREEN, PURPLE, DARK)
"""Colors of curves, in their order."""
LINES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1, 1.2)), (0, (5, 1.5, 1, 1.5)))
"""Lines of curves, in their order."""

WIDTH = 170 / 25.4
"""Width of a figure in inches: the text of an A4 page."""

STYLE: Mapping[str, Any] = MappingProxyType(
    {
        "axes.axisbelow": True,
        "axes.edgecolor": "#666666",
        "axes.formatter.limits": (-4, 5),
        "axes.formatter.useoffset": False,
        "axes.grid": True,
        "axes.labelsize": 8,
        "axes.linewidth": 0.6,
        "axes.prop_cycle": f"cycler(color={[BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY]})",
        "axes.titlesize": 8.5,
        "figure.facecolor": "white",
        "font.family": "DejaVu Sans",
        "font.size": 8,
        "grid.alpha": 1.0,
        "grid.color": "#E6E6E6",
        "grid.linewidth": 0.5,
        "legend.borderaxespad": 0.3,
        "legend.borderpad": 0.25,
        "legend.columnspacing": 1.0,
        "legend.facecolor": "white",
        "legend.fontsize": 7,
        "legend.frameon": True,
        "legend.framealpha": 0.85,
        "legend.edgecolor": "none",
        "legend.handlelength": 1.6,
        "legend.handletextpad": 0.5,
        "legend.labelspacing": 0.25,
        "lines.linewidth": 1.1,
        "mathtext.fontset": "dejavusans",
        "savefig.dpi": 150,
        "svg.fonttype": "path",
        "svg.hashsalt": "loopwright",
        "xtick.color": DARK,
        "xtick.labelsize": 7,
        "ytick.color": DARK,
        "ytick.labelsize": 7,
    }
)


@contextmanager
def style() -> Iterator[None]:
    """Apply our style inside the block only."""
    import matplotlib
    from matplotlib import rcParamsDefault

    plain: dict[Any, Any] = {k: v for k, v in rcParamsDefault.items() if k.split(".")[0] in _OWN}
    with matplotlib.rc_context(plain | dict(STYLE)):
        yield


_OWN = {name.partition(".")[0] for name in STYLE} | {"patch", "path", "text"}
"""Families of settings that a user's own style doesn't reach."""


LETTERS = 118
"""Letters of a legend that fit above a figure of the usual width, side by side."""


def legend_above(figure: Figure, axes: Axes) -> None:
    """Put the legend of axes above a figure, where it hides no curve; a single curve needs none."""
    handles, labels = axes.get_legend_handles_labels()
    if len(labels) < 2:
        return
    columns = legend_columns(labels, figure.get_figwidth())
    figure.legend(handles, labels, loc="outside upper left", ncols=columns)


def legend_columns(labels: Sequence[str], width: float) -> int:
    """Return how many of some labels fit side by side in a width in inches."""
    fitting = LETTERS * width / WIDTH
    if sum(len(label) + 6 for label in labels) <= fitting:  # in one row each column is as wide as its own label
        return len(labels)
    return max(1, min(len(labels), int(fitting) // (max(map(len, labels)) + 6)))


def marker_of(t: np.ndarray) -> str:
    """Return the marker of a line over times: a single sample is a dot."""
    return "." if len(t) == 1 else ""


def limit_time(ax: Axes, t: np.ndarray) -> None:
    """Let the time axis span the times of a run."""
    from matplotlib.ticker import MaxNLocator

    ax.xaxis.set_major_locator(MaxNLocator(8, steps=[1, 2, 5, 10]))
    if len(t) > 1 and t[-1] > t[0]:
        margin = 0.015 * float(t[-1] - t[0])  # the border of the axes must not hide the first tick
        ax.set_xlim(float(t[0]) - margin, float(t[-1]) + margin)
