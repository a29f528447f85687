"""Figures of a run: signals over time, and the plane with the path; drawn without pyplot and without its global state."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from ..blocks._errors import OptionError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ._run import Run
    from .experiments import Experiment

# Okabe and Ito's palette, which colour-blind readers tell apart
BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9"
GREY, DARK = "#A6A6A6", "#333333"

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
def _style() -> Iterator[None]:
    """Apply our style inside the block only."""
    import matplotlib
    from matplotlib import rcParamsDefault

    plain = {k: v for k, v in rcParamsDefault.items() if k.split(".")[0] in _OWN}
    with matplotlib.rc_context({**plain, **STYLE}):
        yield


_OWN = frozenset("axes figure font grid legend lines mathtext patch path savefig svg text xtick ytick".split())


@cache
def _figure_class() -> type[Figure]:
    """Return a figure that a notebook shows, whether or not pyplot was imported."""
    from io import BytesIO

    from matplotlib.figure import Figure

    class Picture(Figure):
        def _repr_png_(self) -> bytes:
            buffer = BytesIO()
            with _style():
                self.savefig(buffer, format="png", dpi=110)
            return buffer.getvalue()

    return Picture


def _figure(height: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = _figure_class()(figsize=(WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, stem: Path) -> tuple[Path, Path]:
    """Write a figure as PNG (150 dpi) and SVG, the same bytes for the same figure, and return the files."""
    files = stem.with_name(stem.name + ".png"), stem.with_name(stem.name + ".svg")
    with _style():
        figure.savefig(files[0], dpi=150, metadata={"Software": None})
        figure.savefig(files[1], metadata={"Date": None, "Creator": None})
    return files


# --- any signals ----------------------------------------------------------------------------------------------------


def plot_signals(run: Run, names: Sequence[str], axes: Any = None) -> Figure:
    """Draw signals over time, one below the other; a vector's entries share an axis.

    Parameters
    ----------
    run : Run
        What was recorded.
    names : sequence of str
        Signals, by the names that ``run[name]`` takes.
    axes : sequence of matplotlib axes, optional
        Axes to draw into, one for each name.

    Returns
    -------
    Figure

    Raises
    ------
    OptionError
        Without a name, or with another number of axes.
    UnknownNameError
        For a name that was not recorded.
    """
    if not names:
        raise OptionError('found no signal to draw; expected names, such as run.plot("eta", "xi").')
    signals = [(name, run[name].reshape(len(run.t), -1), run[name].ndim > 1, _units(run, name)) for name in names]
    with _style():
        if axes is None:
            figure = _figure(0.5 + 1.35 * len(names))
            axes = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
        axes = np.ravel(axes)
        if len(axes) != len(names):
            raise OptionError(f"found {len(axes)} axes for {len(names)} signals; expected one for each.")
        for ax, (name, values, vector, units) in zip(axes, signals, strict=True):
            for i, column in enumerate(values.T):
                unit = f" [{units[i]}]" if vector and len(set(units)) > 1 and units[i] else ""
                ax.plot(run.t, column, label=f"{name}[{i + 1}]{unit}" if vector else name)
            common = units[0] if units and len(set(units)) == 1 else None
            ax.set_ylabel(f"{name} [{common}]" if common else name)
            if vector:
                ax.legend(loc="best", ncols=min(values.shape[1], 3))
        axes[-1].set_xlabel("t [s]")
        for ax in axes:
            _limit_time(ax, run)
        result: Figure = axes[0].figure
        result.align_ylabels()
    return result


def _units(run: Run, name: str) -> list[str]:
    """Return the unit of every entry, as it is to be read."""
    unit, size = run.unit(name), int(np.prod(run[name].shape[1:]))
    units = [u or "" for u in unit] if isinstance(unit, tuple) else [unit or ""] * size
    return [_readable(u) for u in units]


def _readable(unit: str) -> str:
    """Write an FMI unit with superscripts: m/s2 as m/s²."""
    return "" if unit == "1" else unit.translate(str.maketrans("23", "²³")).replace(".", " ")


def _limit_time(ax: Axes, run: Run) -> None:
    if len(run.t) > 1:
        ax.set_xlim(float(run.t[0]), float(run.t[-1]))


# --- the plane ------------------------------------------------------------------------------------------------------


def plot_path(experiment: Experiment, run: Run) -> Figure:
    """Draw the plane: the path, the trace of the end effector, the path reference, and the measured force along it.

    Parameters
    ----------
    experiment : Experiment
        What was run.
    run : Run
        Its run, a complete one or what ``error.run`` holds.
    """
    path, position = experiment.path, run["position"]
    theta = np.linspace(*((0.0, path.period) if path.period is not None else path.domain or (0.0, 1.0)), 721)
    curve = np.asarray(path.sigma(theta))
    reference = _in_plane(path, run["eta_p"][:, 0], run["xi_p"][:, 0])
    points = np.hstack([curve, position.T, reference])
    low, high = points.min(axis=1), points.max(axis=1)
    size = float(np.max(high - low))
    low, high = low - 0.07 * size, high + 0.07 * size
    with _style():
        figure = _figure(min(0.65 + (WIDTH - 0.6) * float((high[1] - low[1]) / (high[0] - low[0])), 8.0))
        ax = figure.subplots()
        ax.set_aspect("equal")
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[1], high[1])
        ax.set_xlabel("y [m]")
        ax.set_ylabel("z [m]")
        ax.plot(*curve, color=GREY, linewidth=2.6, solid_capstyle="round", label="path", zorder=2)
        _mark_start_of_path(ax, path, size)
        if len(run.t):
            ax.plot(*position.T, color=BLUE, linewidth=1.2, label="end effector", zorder=4)
            ax.plot(*reference, color=VERMILION, linestyle=(0, (4, 2.5)), linewidth=1.0, label="path reference", zorder=5)
            _force_arrows(ax, run, size)
            ends = {"marker": "o", "markersize": 5.5, "color": BLUE, "linestyle": "none", "zorder": 7}
            ax.plot(*position[0], markerfacecolor="white", markeredgewidth=1.2, label="start", **ends)
            ax.plot(*position[-1], label="end", **ends)
        ax.legend(loc="center", ncols=1, fontsize=7.5)
    return figure


def _in_plane(path: Any, eta: np.ndarray, xi: np.ndarray) -> np.ndarray:
    """Return σ + n ξ, also where ξ is beyond the reach of the path."""
    if not len(eta):
        return np.zeros((2, 0))
    frame = path.frame(path.parameter_at(eta))
    return np.asarray(frame.sigma + frame.normal * xi)


def _mark_start_of_path(ax: Axes, path: Any, size: float) -> None:
    """Draw a bar across the path at η = 0, and an arrow the way that η grows."""
    start = 0.0 if path.period is not None else path.domain[0]
    frame = path.frame(start)
    sigma, n = np.asarray(frame.sigma), np.asarray(frame.normal)
    bar = np.stack([sigma - 0.02 * size * n, sigma + 0.02 * size * n])
    ax.plot(*bar.T, color=DARK, linewidth=1.2, zorder=3)
    label = r"$\eta_1 = 0$" + (r"$\,,\; L$" if path.closed else "")
    ax.annotate(label, sigma - 0.045 * size * n, ha="center", va="center", fontsize=7.5, color=DARK, rotation=0)


def _force_arrows(ax: Axes, run: Run, size: float) -> None:
    """Draw the measured force at some instants, a legible distance apart in time and place."""
    force, position = run["force"], run["position"]
    strength = np.linalg.norm(force, axis=1)
    largest = float(strength.max())
    if largest <= 1e-9:
        return
    chosen: list[int] = []
    for k in np.arange(0, len(run.t), max(1, len(run.t) // 400)):
        near = [i for i in chosen if np.hypot(*(position[k] - position[i])) < 0.03 * size]
        if strength[k] > 0.05 * largest and not any(force[k] @ force[i] > 0.5 * strength[k] * strength[i] for i in near):
            chosen.append(int(k))
    scale = largest / (0.16 * size)
    arrows = ax.quiver(
        *position[chosen].T, *force[chosen].T, angles="xy", scale_units="xy", scale=scale, color=GREEN, width=0.0028, zorder=6
    )
    nice = _nice(0.6 * largest)
    ax.quiverkey(arrows, 0.86, 0.94, nice, f"force on the robot: {nice:g} N", labelpos="W", fontproperties={"size": 7.5})


def _nice(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above the value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(m for m in (1, 2, 5) if m * power <= value * (1 + 1e-12)))


# --- the signals of an experiment, in the manner of Fig. 4 to 6 -----------------------------------------------------

_PREFIXES = ((1.0, ""), (1e3, "m"), (1e6, "µ"), (1e9, "n"))


def plot_experiment(experiment: Experiment, run: Run) -> Figure:
    """Draw the signals of an experiment in the manner of the paper's Fig. 4 to 6.

    Left the direction along the path, right the one across it; from top to bottom the coordinate with its references,
    the tracking error, the virtual input, the projected force with the desired one. At the bottom the motor forces.

    Parameters
    ----------
    experiment : Experiment
        What was run.
    run : Run
        Its run, a complete one or what ``error.run`` holds.
    """
    with _style():
        figure = _figure(7.6)
        axes = figure.subplots(5, 2, sharex=True)
        for column, side, coordinate, symbol in ((0, "par", "eta", r"\eta"), (1, "perp", "xi", r"\xi")):
            end = {"par": r"\parallel", "perp": r"\perp"}[side]
            _draw_coordinate(axes[0, column], run, coordinate, symbol, side)
            error = run[coordinate][:, 0] - run[f"{coordinate}_p"][:, 0]
            _draw(axes[1, column], run, rf"${symbol}_1 - {symbol}_1^p$", "m", [(error, BLUE, "-", None)])
            v = run[f"v_{side}"]
            _draw(axes[2, column], run, rf"$v_{end}$", "m/s²", [(v, BLUE, "-", None)])
            forces = [(run[f"controller.force_projection.f_{side}"], BLUE, "-", rf"measured $F_{end}$")]
            if f"desired_force_{side}.y" in run:
                forces.append((run[f"desired_force_{side}.y"], VERMILION, "--", rf"desired $F_{end}^d$"))
            _draw(axes[3, column], run, rf"$F_{end}$", "N", forces, floor=1.0)
            _draw(axes[4, column], run, f"motor force {'yz'[column]}", "N", [(run["motor_force"][:, column], BLUE, "-", None)])
            axes[4, column].set_xlabel("t [s]")
        axes[0, 0].set_title(r"along the path ($\parallel$)")
        axes[0, 1].set_title(r"across the path ($\perp$)")
        figure.align_ylabels()
    return figure


def _draw_coordinate(ax: Axes, run: Run, name: str, symbol: str, side: str) -> None:
    """Draw a coordinate, its path reference and, where an admittance lies between, its reference."""
    lines = [(run[name][:, 0], BLUE, "-", rf"${symbol}_1$"), (run[f"{name}_p"][:, 0], VERMILION, "--", rf"${symbol}_1^p$")]
    if f"controller.admittance_{side}.path_reference" in run:
        desired = run[f"{name}_d.y"][:, 0]
        if side == "par" and "set_point.y" in run:
            desired = desired + run["set_point.y"]
        lines.insert(0, (desired, DARK, ":", rf"${symbol}_1^d$"))
    _draw(ax, run, rf"${symbol}_1$", "m", lines)


def _draw(
    ax: Axes,
    run: Run,
    label: str,
    unit: str,
    lines: Sequence[tuple[np.ndarray, str, str, str | None]],
    *,
    floor: float = 0.0,
) -> None:
    """Draw lines into one axis; lengths get the prefix that suits them."""
    largest = max((float(np.max(np.abs(values))) for values, *_ in lines if len(values)), default=0.0)
    factor, prefix = 1.0, ""
    if unit == "m" and largest > 0:
        factor, prefix = next((p for p in _PREFIXES if largest * p[0] >= 0.1), _PREFIXES[-1])
    for values, colour, dashes, name in lines:
        ax.plot(run.t, values * factor, color=colour, linestyle=dashes, label=name, linewidth=1.0 if dashes != "-" else 1.2)
    ax.set_ylabel(f"{label} [{prefix}{unit}]")
    if largest < floor:
        ax.set_ylim(-floor, floor)
    ax.margins(y=0.08)
    _limit_time(ax, run)
    if len(lines) > 1:
        ax.legend(loc="best", ncols=len(lines))
