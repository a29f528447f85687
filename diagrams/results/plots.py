"""Plots of a run's signals over time, and the style of all figures; drawn without pyplot and its global state."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ...blocks.core import OptionError, print_unit, replace_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette, which colour-blind readers tell apart
BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9"
GREY, STONE, DARK = "#A6A6A6", "#6E6E6E", "#333333"
"""Helping lines; curves and texts in the background; texts."""

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


_OWN = {
    "axes",
    "figure",
    "font",
    "grid",
    "legend",
    "lines",
    "mathtext",
    "patch",
    "path",
    "savefig",
    "svg",
    "text",
    "xtick",
    "ytick",
}


@cache
def _figure_class() -> type[Figure]:
    """Return a class of figures that notebooks show, whether or not pyplot was imported."""
    from io import BytesIO

    from matplotlib.figure import Figure

    class Picture(Figure):
        def _repr_png_(self) -> bytes:
            buffer = BytesIO()
            with style():
                self.savefig(buffer, format="png", dpi=110)
            return buffer.getvalue()

        def __reduce__(self) -> tuple[Any, ...]:
            return _bare_figure, (), self.__getstate__()

    return Picture


def _bare_figure() -> Figure:
    """Return a figure that a copy, or a figure from another process, is put into."""
    kind = _figure_class()
    return kind.__new__(kind)


def new_figure(height: float, width: float = WIDTH) -> Figure:
    """Return an empty figure of the usual width, or another one; both are in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = _figure_class()(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


LETTERS = 118
"""Letters of a legend that fit above a figure of the usual width, side by side."""


def legend_above(figure: Figure, axes: Axes) -> None:
    """Put the legend of axes above a figure, where it hides no curve; a single curve needs none."""
    handles, labels = axes.get_legend_handles_labels()
    if len(labels) < 2:
        return
    fitting = LETTERS * figure.get_figwidth() / WIDTH
    columns = max(1, min(len(labels), int(fitting) // (max(map(len, labels)) + 6)))
    figure.legend(handles, labels, loc="outside upper left", ncols=columns)


def save(figure: Figure, stem: Path) -> tuple[Path, Path]:
    """Write a figure as PNG (150 dpi) and SVG, the same bytes for the same figure, and return the files."""
    files = stem.with_name(stem.name + ".png"), stem.with_name(stem.name + ".svg")
    with style(), replace_file(files[0]) as png, replace_file(files[1]) as svg:
        figure.savefig(png, dpi=150, metadata={"Software": None})
        figure.savefig(svg, metadata={"Date": None, "Creator": None})
    return files


LONG = 21
"""Letters of a name with its unit that fit next to the axes of one signal; a longer one is written above them."""


class DrawnSignal(NamedTuple):
    """A signal to draw: its name, its samples (N, …), and the unit of each entry."""

    name: str
    values: np.ndarray
    units: Sequence[str]


def plot_signals(t: np.ndarray, signals: Sequence[DrawnSignal], axes: Sequence[Axes] | None = None) -> Figure:
    """Draw signals over time, one below the other; see `Run.plot`."""
    if not signals:
        raise OptionError('found no signal to draw; expected names, such as run.plot("eta", "xi").')
    signals = [one._replace(units=[print_unit(unit) for unit in one.units]) for one in signals]
    with style():
        if axes is None:
            figure = new_figure(
                0.5 + 1.35 * len(signals) + 0.2 * sum(_is_long(name, units) for name, _, units in signals)
            )
            axes = list(figure.subplots(len(signals), 1, sharex=True, squeeze=False)[:, 0])
        rows: list[Axes] = list(np.ravel(np.asarray(axes, dtype=object)))
        if len(rows) != len(signals):
            raise OptionError(
                f"found {len(rows)} axes for {len(signals)} signals; expected one for each. Make as many, or give none."
            )
        for ax, (name, values, units) in zip(rows, signals, strict=True):
            long, vector = _is_long(name, units), values.ndim > 1
            columns = values.reshape(len(values), int(np.prod(values.shape[1:])))
            for i, column in enumerate(columns.T):
                unit = f" [{units[i]}]" if vector and len(set(units)) > 1 and units[i] else ""
                entry = f"{'' if long else name}[{i + 1}]{unit}"
                ax.plot(t, column, marker=marker_of(t), label=entry if vector else name)
            common = _common(units)
            if long:  # next to the axes it would run into its neighbours
                ax.set_title(name, loc="left", fontsize="medium")
                ax.set_ylabel(common)
            else:
                ax.set_ylabel(f"{name} {common}".rstrip())
            if vector:
                ax.legend(loc="best", ncols=min(columns.shape[1], 3))
        rows[-1].set_xlabel("t [s]")
        for ax in rows:
            limit_time(ax, t)
        top: Any = rows[0].figure  # a figure, or a part of one
        result: Figure = top
        result.align_ylabels()
    return result


def _common(units: Sequence[str]) -> str:
    """Return the unit of all entries in brackets; "" where they differ, or have none."""
    return f"[{units[0]}]" if units and units[0] and len(set(units)) == 1 else ""


def _is_long(name: str, units: Sequence[str]) -> bool:
    """Whether a name with its unit is too long for the side of the axes."""
    return len(f"{name} {_common(units)}") > LONG


def marker_of(t: np.ndarray) -> str:
    """Return the marker of a line over times: a single sample is a dot."""
    return "." if len(t) == 1 else ""


def limit_time(ax: Axes, t: np.ndarray) -> None:
    """Let the time axis span the times of a run."""
    from matplotlib.ticker import MaxNLocator

    ax.xaxis.set_major_locator(MaxNLocator(8, steps=[1, 2, 5, 10]))
    if len(t) > 1:
        margin = 0.015 * float(t[-1] - t[0])  # the border of the axes must not hide the first tick
        ax.set_xlim(float(t[0]) - margin, float(t[-1]) + margin)
