"""Plots of a run's signals over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ...blocks.core import OptionError, print_unit
from ..plotting import limit_time, marker_of, shown_figure, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
    if axes is not None:
        with style():
            return _draw_panels(_check_axes(axes, len(signals)), t, signals)
    height = 0.5 + 1.35 * len(signals) + 0.2 * sum(_is_long(name, units) for name, _, units in signals)
    with shown_figure(height) as figure:
        return _draw_panels(list(figure.subplots(len(signals), 1, sharex=True, squeeze=False)[:, 0]), t, signals)


def _check_axes(axes: Sequence[Axes], count: int) -> list[Axes]:
    """Return axes that are given, as many as are drawn into."""
    rows: list[Axes] = list(np.ravel(np.asarray(axes, dtype=object)))
    if len(rows) != count:
        raise OptionError(
            f"found {len(rows)} axes for {count} signals; expected one for each. Make as many, or give none."
        )
    return rows


def _draw_panels(rows: Sequence[Axes], t: np.ndarray, signals: Sequence[DrawnSignal]) -> Figure:
    """Draw each signal into its axes, and return their figure."""
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
