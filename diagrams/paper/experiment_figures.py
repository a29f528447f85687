"""Figures of the experiments: the plane with the path, and the signals in the manner of the paper's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import wrap
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from ..plotting import BLUE, DARK, GREEN, GREY, VERMILION, WIDTH, limit_time, marker_of, shown_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..results import Run
    from .experiments import Experiment

# --- the plane ------------------------------------------------------------------------------------------------------


def plot_path(experiment: Experiment, run: Run, *, is_shown: bool = True) -> Figure:
    """Draw the plane: the path, the trace of the end effector, the path reference, and the measured force along it.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    run : Run
        Its run, a complete one or what ``error.run`` holds.
    is_shown : bool
        Whether pyplot has the figure, for a person; False for a program that keeps it.
    """
    path, position = experiment.path, run["position"]
    theta = np.linspace(*((0.0, path.period) if path.period is not None else path.domain or (0.0, 1.0)), 721)
    curve = np.asarray(path.sigma(theta))
    reference = _in_plane(path, run["eta_p"][:, 0], run["xi_p"][:, 0])
    size = float(np.max(np.ptp(np.hstack([curve, position.T]), axis=1)))
    ticks, scale = _arrows(position, run["force"], size)
    tips = position[ticks] + run["force"][ticks] * scale
    points = np.hstack([curve, position.T, reference, tips.T])
    low, high = points.min(axis=1) - 0.04 * size, points.max(axis=1) + 0.04 * size
    height = min((1.2 if ticks else 1.0) + (WIDTH - 0.62) * float((high[1] - low[1]) / (high[0] - low[0])), 8.5)
    with shown_figure(height, is_shown=is_shown) as figure:
        ax = figure.subplots()
        ax.set_aspect("equal")
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[1], high[1])
        ax.set_xlabel("y [m]")
        ax.set_ylabel("z [m]")
        figure.suptitle(_title(experiment, run), fontsize=9)
        ax.plot(*curve, color=GREY, linewidth=2.6, solid_capstyle="round", label="path", zorder=2)
        _mark_path(ax, path, size)
        if len(run.t):
            ax.plot(*position.T, color=BLUE, linewidth=1.2, label="end effector", zorder=4)
            dashes = (0, (3, 3))
            ax.plot(*reference, color=VERMILION, linestyle=dashes, linewidth=1.0, label="path reference", zorder=5)
            ends: dict[str, Any] = {"marker": "o", "markersize": 5.5, "color": BLUE, "linestyle": "none", "zorder": 7}
            ax.plot(*position[0], markerfacecolor="white", markeredgewidth=1.2, label="start", **ends)
            ax.plot(*position[-1], label="end", **ends)
        if len(ticks):
            arrows = ax.quiver(
                *position[ticks].T,
                *run["force"][ticks].T,
                angles="xy",
                scale_units="xy",
                scale=1.0 / scale,
                color=GREEN,
                width=0.0022,
                headwidth=4,
                zorder=6,
            )
            nice = _nice(0.08 * size / scale)
            label = f"measured force on the robot, {nice:g} N"
            ax.set_title(" ")  # room for the key
            ax.quiverkey(arrows, 1.0 - nice * scale / float(high[0] - low[0]), 1.03, nice, label, labelpos="W")
        figure.legend(loc="outside lower center", ncols=5)
    return figure


def _title(experiment: Experiment, run: Run) -> str:
    """Return the experiment's name, when it stopped if that was early, and the options that are not the usual ones."""
    from .experiments import DEFAULTS

    text = f"Experiment {experiment.letter}: {experiment.diagram.name.replace('_', ' ')}"
    if not len(run.t):
        text += ", no sample"
    elif run.t[-1] < experiment.duration * (1.0 - 1e-9):
        text += f", stopped after {run.t[-1]:g} s"
    changed = [
        f"{n} = {v}"
        for n, v in experiment.options.items()
        if n not in ("plant", "path") and v != DEFAULTS.get(n, False)
    ]
    return "\n".join([text, *wrap(", ".join(changed), 100)])


def _in_plane(path: Any, eta: np.ndarray, xi: np.ndarray) -> np.ndarray:
    """Return σ + n ξ, also where ξ is beyond the reach of the path."""
    if not len(eta):
        return np.zeros((2, 0))
    frame = path.frame(path.parameter_at(eta))
    return np.asarray(frame.sigma + frame.normal * xi)


def _mark_path(ax: Axes, path: Any, size: float) -> None:
    """Draw a bar across the path at η = 0, and an arrowhead the way that η grows."""
    start = 0.0 if path.period is not None else path.domain[0]
    frame = path.frame(start)
    sigma, n = np.asarray(frame.sigma), np.asarray(frame.normal)
    ax.plot(*np.stack([sigma - 0.018 * size * n, sigma + 0.018 * size * n]).T, color=DARK, linewidth=1.2, zorder=3)
    ax.annotate(
        r"$\eta_1 = 0$", tuple(sigma + 0.06 * size * n), ha="center", va="center", fontsize=7.5, color=DARK, zorder=3
    )
    frame = path.frame(path.parameter_at(0.9 * path.length))
    sigma, t, n = np.asarray(frame.sigma), 0.01 * size * frame.tangent, 0.01 * size * frame.normal
    head = np.stack([sigma + 1.6 * t, sigma - t + n, sigma - 0.6 * t, sigma - t - n])
    ax.fill(*head.T, color=DARK, linewidth=0.0, zorder=3)


def _arrows(position: np.ndarray, force: np.ndarray, size: float) -> tuple[list[int], float]:
    """Return the ticks whose force is drawn, a legible distance apart in place or direction, and the scale in m/N."""
    strength = np.linalg.norm(force, axis=1)
    largest = float(strength.max(initial=0.0))
    chosen: list[int] = []
    if largest <= 1e-9:
        return chosen, 1.0
    for k in range(0, len(force), max(1, len(force) // 600)):
        close = [i for i in chosen if np.hypot(*(position[k] - position[i])) < 0.035 * size]
        alike = any(force[k] @ force[i] > 0.5 * strength[k] * strength[i] for i in close)
        if strength[k] > 0.05 * largest and not alike:
            chosen.append(k)
    return chosen, 0.11 * size / largest


def _nice(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above the value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(m for m in (1, 2, 5) if m * power <= value * (1 + 1e-12)))


# --- the signals of an experiment, in the manner of Fig. 4 to 6 -----------------------------------------------------

_PREFIXES = ((1.0, ""), (1e3, "m"), (1e6, "µ"), (1e9, "n"))
_ACTUAL: Mapping[str, Any] = MappingProxyType({"color": BLUE, "linewidth": 1.2})
_PATH_REFERENCE: Mapping[str, Any] = MappingProxyType({"color": VERMILION, "linewidth": 1.0, "linestyle": (0, (3, 3))})
_DESIRED: Mapping[str, Any] = MappingProxyType({"color": DARK, "linewidth": 1.0, "linestyle": (0, (1, 1.5))})


def plot_experiment(experiment: Experiment, run: Run, *, is_shown: bool = True) -> Figure:
    """Draw the signals of an experiment in the manner of the paper's Fig. 4 to 6.

    Left the direction along the path, right the one across it; from top to bottom the coordinate with its references,
    the tracking error (its magnitude on a logarithmic axis where the initial error towers over all that follows), the
    virtual input, the projected force with the desired one (left out where there is none), the motor forces.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    run : Run
        Its run, a complete one or what ``error.run`` holds.
    is_shown : bool
        Whether pyplot has the figure, for a person; False for a program that keeps it.
    """
    from matplotlib.lines import Line2D

    forces = [run["controller.force_projection.f_par"], run["controller.force_projection.f_perp"]]
    wanted = [run[name] if (name := f"desired_force_{side}.y") in run else None for side in ("par", "perp")]
    has_force = bool(np.any(forces)) or any(f is not None for f in wanted)
    admittance = "controller.admittance_par.path_reference" in run
    rows = 5 if has_force else 4
    with shown_figure(0.75 + 1.4 * rows, is_shown=is_shown) as figure:
        axes = figure.subplots(rows, 2, sharex=True)
        for column, side, coordinate, symbol in ((0, "par", "eta", r"\eta"), (1, "perp", "xi", r"\xi")):
            end = {"par": r"\parallel", "perp": r"\perp"}[side]
            value, reference = run[coordinate][:, 0], run[f"{coordinate}_p"][:, 0]
            lines = [(value, _ACTUAL), (reference, _PATH_REFERENCE)]
            if admittance:
                desired = run[f"{coordinate}_d.y"][:, 0]
                moved = side == "par" and "set_point.y" in run
                lines.insert(0, (desired + run["set_point.y"] if moved else desired, _DESIRED))
            panels = iter(axes[:, column])
            _draw(next(panels), run, f"${symbol}_1$", "m", lines)
            _draw_error(next(panels), run, f"{symbol}_1 - {symbol}_1^p", value - reference)
            _draw(next(panels), run, f"$v_{end}$", "m/s²", [(run[f"v_{side}"], _ACTUAL)])
            if has_force:
                force = wanted[column]
                lines = [(force, _DESIRED)] if force is not None else []
                _draw(next(panels), run, f"$F_{end}$", "N", [*lines, (forces[column], _ACTUAL)], floor=1.0)
            _draw(next(panels), run, f"motor force {'yz'[column]}", "N", [(run["motor_force"][:, column], _ACTUAL)])
            axes[-1, column].set_xlabel("t [s]")
        axes[0, 0].set_title(r"along the path, $\parallel$")
        axes[0, 1].set_title(r"across the path, $\perp$")
        figure.suptitle(_title(experiment, run), fontsize=9)
        used = [("actual", _ACTUAL), (r"path reference $\eta^p$, $\xi^p$", _PATH_REFERENCE)]
        if admittance:
            used.append(
                (r"desired $\eta^d$, $\xi^d$" + (", $F^d$" if any(f is not None for f in wanted) else ""), _DESIRED)
            )
        keys = [Line2D([], [], label=label, **look) for label, look in used]
        figure.legend(handles=keys, loc="outside lower center", ncols=len(keys), handlelength=2.4)
        figure.align_ylabels()
    return figure


def _draw_error(ax: Axes, run: Run, label: str, error: np.ndarray) -> None:
    """Draw a tracking error; its magnitude on a logarithmic axis where the first value is far above the usual ones."""
    if len(error) > 1 and abs(error[0]) > 100.0 * np.median(np.abs(error)) and abs(error[0]) > 1e-4:
        magnitude = np.maximum(np.abs(error), 1e-12)
        factor, prefix = _prefix(float(magnitude.max()))
        ax.plot(run.t, magnitude * factor, marker=marker_of(run.t), **_ACTUAL)
        ax.set_yscale("log")
        ax.set_ylim(max(magnitude.min(), 1e-8) * factor, 3.0 * magnitude.max() * factor)
        ax.set_ylabel(f"$|{label}|$ [{prefix}m]")
        limit_time(ax, run.t)
    else:
        _draw(ax, run, f"${label}$", "m", [(error, _ACTUAL)])


def _prefix(largest: float) -> tuple[float, str]:
    """Return the factor and the prefix that suit a length."""
    return next((p for p in _PREFIXES if largest * p[0] >= 0.1), _PREFIXES[-1]) if largest > 0 else _PREFIXES[0]


def _draw(
    ax: Axes,
    run: Run,
    label: str,
    unit: str,
    lines: Sequence[tuple[np.ndarray, Mapping[str, Any]]],
    *,
    floor: float = 0.0,
) -> None:
    """Draw lines into one axis; lengths get the prefix that suits them."""
    largest = max((float(np.max(np.abs(values))) for values, _ in lines if len(values)), default=0.0)
    factor, prefix = _prefix(largest) if unit == "m" else (1.0, "")
    for values, look in lines:
        ax.plot(run.t, values * factor, marker=marker_of(run.t), **look)
    ax.set_ylabel(f"{label} [{prefix}{unit}]")
    ax.margins(y=0.08)
    if largest < floor:
        ax.set_ylim(-floor, floor)
    limit_time(ax, run.t)
