"""Plots of runs: signals over time, measured data over them, and a path in the plane."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import cycle
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike

from ...blocks.core import OptionError, UnitError, convert_unit, enumerate_some, print_unit, same_dimension, shorten
from ..plotting import (
    COLORS,
    DARK,
    LINES,
    STONE,
    WIDTH,
    legend_above,
    legend_columns,
    limit_time,
    marker_of,
    shown_figure,
    style,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from .stored import Occurrence

LONG = 21
"""Letters of a name with its unit that fit next to the axes of one signal; a longer one is written above them."""
DASHES: Any = (0, (4, 2))
"""Line of a set-point."""
TICKS = 2000
"""Events are marked so far apart at least, as a part of the time that is shown."""
TIMES = ("t", "time", "Time")
"""Names of a table's column of times, s."""
Data = tuple[ArrayLike, ArrayLike] | Mapping[str, ArrayLike] | Any
"""Measured data: times and samples of one signal, or columns by name with the times in "t"; also a data frame."""
_FORMS = '(t, y), {"t": t, "speed": y} or a data frame with a column "t"'


@dataclass(frozen=True)
class DrawnSignal:
    """A signal to draw."""

    name: str
    t: np.ndarray  # s, (N,)
    values: np.ndarray  # (N, …)
    units: Sequence[str]  # of each entry
    run: str = ""  # name of its run; "" where there is one
    is_set_point: bool = False  # it comes from a source: nothing in the diagram changes it
    is_held: bool = False  # between its samples
    limits: tuple[float, ...] = ()  # that it is kept within

    def in_units(self, units: Sequence[str]) -> DrawnSignal:
        """Return the signal with each entry in its unit of these, where it has one of the same dimension."""
        if len(units) != len(self.units) or list(units) == list(self.units):
            return self
        ways = [_conversion(a, b) for a, b in zip(self.units, units, strict=True)]
        factors, offsets = np.array([way or (1.0, 0.0) for way in ways]).T
        shape = self.values.shape[1:]
        return replace(
            self,
            values=self.values * np.reshape(factors, shape) + np.reshape(offsets, shape),
            units=[a if way is None else b for a, b, way in zip(self.units, units, ways, strict=True)],
            limits=tuple(factors[0] * limit + offsets[0] for limit in self.limits) if len(set(ways)) == 1 else (),
        )


def _conversion(a: str, b: str) -> tuple[float, float] | None:
    """Return the factor and the offset from a unit to another; None where there are none."""
    try:
        return convert_unit(a, b) if a and b and same_dimension(a, b) else None
    except UnitError:  # a name that an FMU doesn't define
        return None


Panel = Sequence[DrawnSignal]
"""The signals of one axis: those of the first run, then those of the next one."""


def plot_signals(
    panels: Sequence[Panel],
    events: Sequence[Occurrence] = (),
    axes: Sequence[Axes] | np.ndarray | None = None,
    xlim: tuple[float, float] | None = None,
) -> Figure:
    """Draw signals over time, one axis below the other; see `Run.plot`."""
    if not panels:
        raise OptionError('found no signal to draw; expected names. Give them: run.plot("eta", "xi").')
    if axes is not None:
        with style():
            own: list[Axes] = list(np.ravel(np.asarray(axes, dtype=object)))
            if len(own) != len(panels):
                raise OptionError(
                    f"found {len(own)} axes for {len(panels)} signals; expected one for each. Make as many, or give "
                    "none."
                )
            return _draw_panels(own, panels, events, xlim)
    height = 0.5 + 1.35 * len(panels) + 0.2 * sum(_is_long(panel) for panel in panels)
    with shown_figure(height) as figure:
        rows = list(figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0])
        drawn = _draw_panels(rows, panels, events, xlim)
        if all(_has_legend_of_runs(panel) for panel in panels):
            legend_above(figure, rows[0])
        return drawn


def _draw_panels(
    rows: Sequence[Axes], panels: Sequence[Panel], events: Sequence[Occurrence], xlim: tuple[float, float] | None
) -> Figure:
    """Draw each panel into its axes, and return their figure."""
    every = [one for panel in panels for one in panel]
    times = [one.t for one in every if len(one.t)]
    ends = np.array([min(t[0] for t in times), max(t[-1] for t in times)]) if times else np.zeros(0)
    shown = np.array(ends if xlim is None else xlim)
    shared = all(_has_legend_of_runs(panel) for panel in panels)
    for ax, panel in zip(rows, panels, strict=True):
        _draw_panel(ax, panel)
        if _has_legend(panel) and not (shared and _has_legend_of_runs(panel)):
            _legend_over(ax)
        if xlim is not None:
            _fit(ax, panel, xlim)
        limit_time(ax, shown)
        if xlim is not None:
            ax.set_xlim(*xlim)
    _mark_events(rows, events, shown)
    rows[-1].set_xlabel("t [s]")
    figure = cast("Figure", rows[0].figure)  # a figure, or a part of one
    figure.align_ylabels()
    return figure


def _legend_over(ax: Axes) -> None:
    """Put a legend over the upper edge of axes, at the right, where it hides no curve."""
    look: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.0}
    figure: Any = ax.figure  # a figure, or a part of one
    width = figure.get_figwidth() if hasattr(figure, "get_figwidth") else WIDTH
    ax.legend(ncols=legend_columns(ax.get_legend_handles_labels()[1], width), frameon=False, **look)


def _draw_panel(ax: Axes, panel: Panel) -> None:
    """Draw the signals of one axis, with their limits where these are near."""
    single, is_long, common = _only_name(panel), _is_long(panel), _common(panel)
    runs = list(dict.fromkeys(one.run for one in panel))
    by_run = _has_legend_of_runs(panel)
    colors: dict[object, str] = {}
    wheel = cycle(COLORS)
    mixed = {one.is_set_point for one in panel} == {True, False}
    for number, one in enumerate(panel):
        dashed = mixed and one.is_set_point
        if dashed and any(_is_same(one, earlier) for earlier in panel[:number]):
            continue  # the set-point of all runs
        for label, column, key in _columns(one, short=is_long, common=common):
            color = colors.setdefault(one.run if by_run else key, "") or next(wheel)
            colors[one.run if by_run else key] = color
            line = DASHES if dashed else LINES[0 if by_run else runs.index(one.run) % len(LINES)]
            is_shared = dashed and all(_is_same(one, other) for other in panel if other.name == one.name)
            name = one.run if by_run else ", ".join(filter(None, [label, "" if is_shared else one.run]))
            drawn = "steps-post" if one.is_held else "default"
            look: dict[str, Any] = {"color": color, "linestyle": line, "drawstyle": drawn, "marker": marker_of(one.t)}
            ax.plot(one.t, column, label=name, zorder=2.1 if dashed else 2.0, **look)
    if is_long:  # next to the axes it would run into its neighbours
        ax.set_title(panel[0].name, loc="left", fontsize="medium")
        ax.set_ylabel(common)
    else:
        ax.set_ylabel(f"{panel[0].name if single else ''} {common}".strip())
    low, high = ax.get_ylim()
    for limit in dict.fromkeys(limit for one in panel for limit in one.limits):
        if low - 0.5 * (high - low) <= limit <= high + 0.5 * (high - low):
            ax.axhline(limit, color=STONE, linewidth=0.8, linestyle=(0, (1, 1.5)), zorder=1.5)


def _columns(one: DrawnSignal, *, short: bool, common: str) -> Iterator[tuple[str, np.ndarray, object]]:
    """Yield the label, the samples and a key of each entry of a signal."""
    units = [print_unit(unit) for unit in one.units]
    columns = one.values.reshape(len(one.values), int(np.prod(one.values.shape[1:])))
    for i, column in enumerate(columns.T):
        unit = f" [{units[i]}]" if not common and units[i] else ""
        entry = f"[{i + 1}]" if one.values.ndim > 1 else ""
        yield ("" if short and entry else one.name) + entry + unit, column, (one.name, i)


def _only_name(panel: Panel) -> bool:
    """Whether an axis has one signal, of one or several runs."""
    return len({one.name for one in panel}) == 1


def _has_legend_of_runs(panel: Panel) -> bool:
    """Whether the curves of an axis differ in their runs alone."""
    alike = len({unit for one in panel for unit in one.units}) == 1 and all(one.values.ndim == 1 for one in panel)
    return alike and _only_name(panel) and len({one.run for one in panel}) > 1


def _has_legend(panel: Panel) -> bool:
    return len(panel) > 1 or any(one.values.ndim > 1 for one in panel)


def _common(panel: Panel) -> str:
    """Return the unit of all curves in brackets; "" where they differ, or have none."""
    units = {print_unit(unit) for one in panel for unit in one.units}
    return f"[{next(iter(units))}]" if len(units) == 1 and next(iter(units)) else ""


def _is_long(panel: Panel) -> bool:
    """Whether the name of an axis with its unit is too long for its side."""
    return _only_name(panel) and len(f"{panel[0].name} {_common(panel)}") > LONG


def _is_same(one: DrawnSignal, other: DrawnSignal) -> bool:
    return one.name == other.name and np.array_equal(one.t, other.t) and np.array_equal(one.values, other.values)


def _fit(ax: Axes, panel: Panel, xlim: tuple[float, float]) -> None:
    """Let an axis span the values within some times, with those next to the ends."""
    found = []
    for one in panel:
        first = max(int(np.searchsorted(one.t, xlim[0], side="right")) - 1, 0)
        last = int(np.searchsorted(one.t, xlim[1])) + 1
        found.append(np.ravel(one.values[first:last]))
    values = np.concatenate(found)
    values = values[np.isfinite(values)]
    if values.size and (span := float(np.ptp(values))) > 0.0:
        ax.set_ylim(float(values.min()) - 0.05 * span, float(values.max()) + 0.05 * span)


def _mark_events(rows: Sequence[Axes], events: Sequence[Occurrence], shown: np.ndarray) -> None:
    """Mark events by ticks at the lower end of each axis, with the names of their blocks above the first one."""
    mine = [event for event in events if len(shown) and shown[0] <= event.t <= shown[-1]]
    if not mine:
        return
    step = max(float(shown[-1] - shown[0]) / TICKS, 1e-300)
    times = list({round(event.t / step): event.t for event in mine}.values())
    for ax in rows:
        ax.vlines(times, 0.0, 0.05, transform=ax.get_xaxis_transform(), color=DARK, linewidth=0.8, gid="events")
    blocks = list(dict.fromkeys(event.block for event in mine))
    named = ", ".join(blocks[:3]) + ("" if len(blocks) <= 3 else f" and {len(blocks) - 3} more")
    rows[0].set_title(f"ticks: events of {named}", loc="left", fontsize="small", color=STONE)


def plot_curve(
    curves: Mapping[str, tuple[np.ndarray, np.ndarray]], labels: tuple[str, str], axes: Axes | None, *, is_equal: bool
) -> Figure:
    """Draw paths in the plane, by the names of their runs; see `Run.plot_path`."""
    if axes is not None:
        with style():
            return _draw_curve(axes, curves, labels, is_equal=is_equal)
    points = [np.stack(pair) for pair in curves.values()]
    spans = np.ptp(np.hstack(points), axis=1) if any(p.size for p in points) else np.ones(2)
    ratio = float(spans[1] / spans[0]) if is_equal and spans[0] > 0.0 else 0.6
    with shown_figure(float(np.clip(0.5 + (WIDTH - 0.6) * ratio, 2.0, 6.0))) as figure:
        drawn = _draw_curve(figure.subplots(), curves, labels, is_equal=is_equal)
        legend_above(figure, figure.axes[0])
        return drawn


def _draw_curve(
    ax: Axes, curves: Mapping[str, tuple[np.ndarray, np.ndarray]], labels: tuple[str, str], *, is_equal: bool
) -> Figure:
    """Draw paths into axes: each begins at an open circle and ends at a full one."""
    single = len(curves) == 1
    for (name, (x, y)), color in zip(curves.items(), cycle(COLORS), strict=False):
        ax.plot(x, y, color=color, label=None if single else name)
        ends: dict[str, Any] = {"marker": "o", "markersize": 5.0, "color": color, "linestyle": "none"}
        start = "start" if single else None
        ax.plot(x[:1], y[:1], markerfacecolor="white", markeredgewidth=1.1, label=start, **ends)
        ax.plot(x[-1:], y[-1:], label="end" if single else None, **ends)
    if is_equal:
        ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel=labels[0], ylabel=labels[1])
    return cast("Figure", ax.figure)


class MeasuredSignals:
    """Samples of some signals, at their own times.

    ``data`` is a pair of times in s, (N,), and samples of one signal, (N, …); or columns by name, with the times in
    ``"t"`` or ``"time"``, of a data frame also in its index. ``label`` is for the legend.
    """

    def __init__(self, data: Any, label: str):
        self.label = label
        self._signals: dict[str | None, np.ndarray] = {}  # None: of the only signal that is drawn
        columns = _columns_of(data)
        if columns is None:
            self.t, values = self._read(data[0], "t"), self._read(data[1], "y")
            self._signals[None] = values
        else:
            times = next((name for name in TIMES if name in columns), None)
            index = getattr(data, "index", None)
            self.t = self._read(index if times is None else columns[times], times or "its index")
            self._signals.update({name: self._read(one, name) for name, one in columns.items() if name not in TIMES})
        if self.t.ndim != 1 or not self._signals:
            raise self._error(f"found times of shape {self.t.shape} and {len(self._signals)} signals")
        for name, values in self._signals.items():
            if values.shape[:1] != self.t.shape:
                raise self._error(f"found {len(self.t)} times and samples of shape {values.shape} of {name or 'y'}")

    def drawn(self, like: DrawnSignal) -> DrawnSignal | None:
        """Return the samples of a signal of a run, as it is drawn; None where there are none."""
        values = self._signals.get(None, self._signals.get(like.name))
        if values is None:
            return None
        if values.shape[1:] != like.values.shape[1:]:
            raise self._error(
                f"found samples of shape {values.shape} of {like.name}, which is {like.values.shape} in the run"
            )
        return DrawnSignal(like.name, self.t, values, like.units, self.label)

    def check_names(self, names: Sequence[str]) -> None:
        """Refuse data of which nothing is drawn, and a pair where several signals are drawn."""
        if None in self._signals:
            if len(names) > 1:
                raise OptionError(
                    f"found a pair (t, y), which is one signal, and {len(names)} signals to draw; expected columns by "
                    f'name. Write {{"t": t, "{names[0]}": y}}.',
                    block="Run.plot",
                    port=f"against[{self.label!r}]",
                )
        elif not {*names} & {*self._signals}:
            raise OptionError(
                f"found the columns {enumerate_some([*map(repr, self._signals)])}; expected one of the signals that "
                f"are drawn, {enumerate_some([*map(repr, names)])}. Rename a column.",
                block="Run.plot",
                port=f"against[{self.label!r}]",
            )

    def _read(self, values: Any, name: object) -> np.ndarray:
        try:
            found = np.asarray(values, dtype=float)
        except (TypeError, ValueError):
            raise self._error(f"found {shorten(values):.40} … as {name}") from None
        return found

    def _error(self, found: str) -> OptionError:
        return OptionError(
            f"{found}; expected numbers at times in s, {_FORMS}. Give as many times as samples.",
            block="Run.plot",
            port=f"against[{self.label!r}]",
        )


def split_measured(against: Any) -> tuple[Any, list[MeasuredSignals]]:
    """Return what may be runs by their names, or None without any, and the measured data next to them."""
    if _is_measured(against):
        return None, [MeasuredSignals(against, "measured")]
    if not isinstance(against, Mapping):
        return against, []
    data = [MeasuredSignals(one, str(name)) for name, one in against.items() if _is_measured(one)]
    runs = {name: one for name, one in against.items() if not _is_measured(one)}
    return (runs or None if data else against), data


def _is_measured(value: object) -> bool:
    """Whether a value is meant as measured data, and not as a run, or runs by their names."""
    is_pair = isinstance(value, tuple | list) and len(value) == 2 and all(np.ndim(one) > 0 for one in value)
    return is_pair or _columns_of(value) is not None


def _columns_of(value: Any) -> dict[str, Any] | None:
    """Return the columns of a table by name; None for anything else."""
    if isinstance(value, Mapping):
        arrays = value and all(
            isinstance(one, np.ndarray | list | tuple) or hasattr(one, "to_numpy") for one in value.values()
        )
        return dict(value) if arrays and any(name in value for name in TIMES) else None
    if hasattr(value, "columns") and hasattr(value, "to_numpy"):  # of pandas, polars
        return {str(name): value[name] for name in value.columns}
    return None
