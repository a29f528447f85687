"""Bode, Nyquist and Nichols plots, step responses and the gang of four, of one loop or of several in one figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ...blocks.core import OptionError, shorten, with_unit
from ..results import BLUE, DARK, GREEN, GREY, PURPLE, STONE, VERMILION, legend_above, new_figure, style
from .realization import Realization

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = (BLUE, VERMILION, GREEN, PURPLE, DARK)
LINES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1, 1.2)), (0, (5, 1.5, 1, 1.5)))
POINTS = 800
BELOW = 1 - 1e-6
"""Part of π/T up to which a sampled loop is drawn."""
FAR = 8.0
"""Largest part of the plane that a Nyquist plot shows: the real and imaginary part up to this."""


def is_measured(loop: Any) -> bool:
    """Whether a loop is frequency-response data rather than a linear system."""
    return hasattr(loop, "frdata") and hasattr(loop, "omega")


def labels_of(loops: Sequence[Any], labels: Sequence[str] | None) -> list[str]:
    """Return a label for each loop: its name, numbered where it repeats.

    Raises
    ------
    OptionError
        If there is another number of labels than of loops.
    """
    if labels is not None:
        if len(labels) != len(loops):
            raise OptionError(
                f"found {len(labels)} labels for {len(loops)} loops; expected one for each. Give as many.",
                port="labels",
            )
        return [str(label) for label in labels]
    names = [str(getattr(loop, "name", None) or "loop") for loop in loops]
    return [f"{n} ({names[: i + 1].count(n)})" if names.count(n) > 1 else n for i, n in enumerate(names)]


def check_single(loops: Sequence[Any]) -> None:
    """Refuse loops with several inputs or outputs.

    Raises
    ------
    OptionError
        If a loop is no system with one input and one output.
    """
    for loop in loops:
        size = getattr(loop, "noutputs", None), getattr(loop, "ninputs", None)
        if size != (1, 1):
            found = f"{size[0]} outputs and {size[1]} inputs" if size[0] else f"{type(loop).__name__}"
            raise OptionError(
                f"found {found}; expected a loop with one input and one output, as linearize().loop('u') or a "
                "python-control system. Plot an entry, L[0, 0], or look at mimo_disk_margin(L).",
                block=str(getattr(loop, "name", None) or "loop"),
            )


def frequencies(loop: Any) -> np.ndarray:
    """Return frequencies in rad/s over which a loop is worth looking at: around its crossovers, poles and zeros."""
    if is_measured(loop):
        return np.asarray(loop.omega, dtype=float)
    dt = float(loop.dt or 0.0)
    limit = np.pi / dt if dt else np.inf
    marks = np.abs(np.concatenate([np.ravel(loop.poles()), np.ravel(loop.zeros())]))
    if dt:
        roots = np.concatenate([np.ravel(loop.poles()), np.ravel(loop.zeros())]).astype(complex)
        with np.errstate(all="ignore"):
            marks = np.abs(np.log(roots[np.abs(roots) > 1e-6]) / dt)
    marks = marks[np.isfinite(marks) & (marks > 1e-6) & (marks < limit)]
    high = min(1e3 * float(np.max(marks, initial=1.0)), limit)
    wide = np.geomspace(1e-3 * float(np.min(marks, initial=min(1.0, 0.1 * limit))), high, 2000)
    size = np.abs(Realization.of(loop).response(wide * (1 - 1e-9))[0])
    crossed = wide[1:][(size[1:] > 1.0) != (size[:-1] > 1.0)]
    if crossed.size:
        low, high = float(crossed[0]) / 50, min(float(crossed[-1]) * 50, limit)
    else:
        low, high = wide[0] * 100, min(high / 30, limit)
    return np.geomspace(min(low, high / 100), high * (1 - 1e-9 if dt else 1.0), POINTS)


def response(loop: Any, omega: np.ndarray) -> np.ndarray:
    """Return the values of a loop at frequencies in rad/s; of data those that it has."""
    if is_measured(loop):
        return np.asarray(np.reshape(loop.frdata, (1, 1, -1))[0, 0], dtype=complex)
    return np.asarray(Realization.of(loop).response(omega)[0])


def _span(loops: Sequence[Any], omega: ArrayLike | None) -> list[np.ndarray]:
    """Return the frequencies of each loop: those that are asked for, below half its sampling frequency."""
    own = [frequencies(loop) for loop in loops]
    low, high = min(float(w[0]) for w in own), max(float(w[-1]) for w in own)
    spans = []
    for loop, w in zip(loops, own, strict=True):
        if is_measured(loop):
            spans.append(w)
            continue
        if omega is None:
            spans.append(Realization.of(loop).grid(low, high, POINTS))
            continue
        asked = _read_omega(omega)
        limit = _limit(loop)
        shown = asked[asked < limit]
        if not shown.size:
            raise OptionError(
                f"found {shorten(omega)} rad/s, none below π/T = {limit:.6g} rad/s of the loop sampled every "
                f"{float(loop.dt):g} s; expected one at least. Give lower ones, or leave the loop out.",
                port="omega",
            )
        spans.append(
            np.append(shown, limit * BELOW) if shown.size < asked.size and shown[-1] < limit * BELOW else shown
        )
    return spans


def _read_omega(omega: Any) -> np.ndarray:
    """Return frequencies that were given, in ascending order, each once."""
    try:
        asked = np.unique(np.asarray(omega, dtype=float))
    except (TypeError, ValueError):
        asked = np.zeros(0)
    if not (asked.size and np.all(np.isfinite(asked)) and np.all(asked > 0.0)):
        raise OptionError(f"found {shorten(omega)}; expected positive frequencies in rad/s. Give some.", port="omega")
    return asked


def _limit(loop: Any) -> float:
    """Return half the sampling frequency of a loop in rad/s; infinite of a continuous one, and of data."""
    dt = 0.0 if is_measured(loop) else float(loop.dt or 0.0)
    return float(np.pi) / dt if dt else np.inf


def _note_ends(axes: Axes, loops: Sequence[Any], names: Sequence[str], omega: ArrayLike | None) -> None:
    """Say in a figure which loops end at π/T although higher frequencies were asked for."""
    if omega is None:
        return
    highest = _read_omega(omega)[-1]
    cut = [
        f"{name} at π/T = {_limit(loop):.4g} rad/s"
        for name, loop in zip(names, loops, strict=True)
        if highest >= _limit(loop)
    ]
    if cut:
        axes.set_title("Ends: " + ", ".join(cut), loc="left", fontsize="small")


def _look(i: int, loop: Any) -> dict[str, Any]:
    color = COLORS[i % len(COLORS)]
    if is_measured(loop):
        return {"color": color, "linestyle": "none", "marker": "o", "markersize": 3.5, "fillstyle": "none"}
    return {"color": color, "linestyle": LINES[(i // len(COLORS) + i) % len(LINES)]}


def _phase(values: np.ndarray) -> np.ndarray:
    """Return the phase in degrees without jumps; at the lowest frequency it lies in (−270°, 90°]."""
    phase = np.degrees(np.unwrap(np.angle(values)))
    return np.asarray(phase - 360.0 * np.ceil((phase[0] - 90.0) / 360.0))


def _legend(figure: Figure, axes: Axes) -> None:
    legend_above(figure, axes)
    figure.align_ylabels()


def bode(loops: Sequence[Any], omega: ArrayLike | None, labels: Sequence[str] | None, *, db: bool, hz: bool) -> Figure:
    """Return the gain and the phase over frequency; see `LoopTransfer.bode`."""
    check_single(loops)
    names, unit = labels_of(loops, labels), 2.0 * np.pi if hz else 1.0
    with style():
        figure = new_figure(4.4)
        gain, phase = figure.subplots(2, 1, sharex=True)
        for i, (loop, w) in enumerate(zip(loops, _span(loops, omega), strict=True)):
            values = response(loop, w)
            size = np.abs(values)
            gain.plot(w / unit, 20.0 * np.log10(size) if db else size, label=names[i], **_look(i, loop))
            phase.plot(w / unit, _phase(values), **_look(i, loop))
        gain.set_xscale("log")
        if not db:
            gain.set_yscale("log")
        gain.axhline(0.0 if db else 1.0, color=GREY, linewidth=0.8, zorder=0)
        phase.axhline(-180.0, color=GREY, linewidth=0.8, zorder=0)
        low, high = phase.get_ylim()
        step = 45.0 if high - low < 400.0 else 90.0 if high - low < 900.0 else 360.0
        phase.set_yticks(np.arange(np.ceil(low / step) * step, high + 1e-9, step))
        gain.set_ylabel(with_unit("|L|", "dB" if db else "1"))
        phase.set_ylabel(with_unit("phase of L", "deg"))
        phase.set_xlabel(with_unit("frequency", "Hz") if hz else with_unit("ω", "rad/s"))
        _note_ends(gain, loops, names, omega)
        _legend(figure, gain)
    return figure


def nyquist(loops: Sequence[Any], omega: ArrayLike | None, labels: Sequence[str] | None) -> Figure:
    """Return the loci of the loops around −1; see `LoopTransfer.nyquist`."""
    check_single(loops)
    names, reach = labels_of(loops, labels), 1.6
    with style():
        figure = new_figure(5.0)
        axes = figure.subplots()
        axes.plot(np.cos(turn := np.linspace(0, 2 * np.pi, 200)), np.sin(turn), color=GREY, linewidth=0.8, zorder=0)
        for i, (loop, w) in enumerate(zip(loops, _span(loops, omega), strict=True)):
            values = response(loop, w)
            look = _look(i, loop)
            axes.plot(values.real, values.imag, label=names[i], **look)
            crossed = np.flatnonzero((values.imag[1:] > 0) != (values.imag[:-1] > 0))
            left = -values.real[crossed]
            reach = max(reach, 1.2 * float(np.max(left[left < FAR], initial=0.0)))
            if is_measured(loop):
                continue
            axes.plot(values.real, -values.imag, color=look["color"], linewidth=0.6, alpha=0.6)
            near = np.flatnonzero(np.abs(values) < 0.8 * max(reach, 1.6))
            if near.size and near[0] + 1 < len(values):
                k = min(int(near[0]) + 1, len(values) - 2)
                axes.annotate(
                    "",
                    xy=(values[k + 1].real, values[k + 1].imag),
                    xytext=(values[k].real, values[k].imag),
                    arrowprops={"arrowstyle": "-|>", "color": look["color"], "mutation_scale": 12},
                )
        axes.plot([-1.0], [0.0], marker="+", color=DARK, markersize=9, linestyle="none")
        axes.annotate("−1", (-1.0, 0.0), (-6, 5), textcoords="offset points", ha="right", fontsize=7)
        axes.axhline(0.0, color=GREY, linewidth=0.6, zorder=0)
        axes.axvline(0.0, color=GREY, linewidth=0.6, zorder=0)
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xlabel="Re L", ylabel="Im L")
        _note_ends(axes, loops, names, omega)
        _legend(figure, axes)
    return figure


def nichols(loops: Sequence[Any], omega: ArrayLike | None, labels: Sequence[str] | None) -> Figure:
    """Return gain over phase, with contours of |T|; see `LoopTransfer.nichols`."""
    check_single(loops)
    names = labels_of(loops, labels)
    with style():
        figure = new_figure(4.6)
        axes = figure.subplots()
        for i, (loop, w) in enumerate(zip(loops, _span(loops, omega), strict=True)):
            values = response(loop, w)
            axes.plot(_phase(values), 20.0 * np.log10(np.abs(values)), label=names[i], **_look(i, loop))
        left, right = axes.get_xlim()
        left, right = min(left, -225.0), max(right, -90.0)
        low, high = max(axes.get_ylim()[0], -40.0), min(axes.get_ylim()[1], 40.0)
        low, high = min(low, -20.0), max(high, 20.0)
        phase, gain = np.meshgrid(np.linspace(left, right, 400), np.linspace(low, high, 300))
        value = 10.0 ** (gain / 20.0) * np.exp(1j * np.radians(phase))
        with np.errstate(divide="ignore"):
            closed = 20.0 * np.log10(np.abs(value / (1.0 + value)))
        lines = axes.contour(phase, gain, closed, levels=[-12, -6, -3, 0, 3, 6, 12], colors=STONE, linewidths=0.5)
        axes.clabel(lines, fmt=lambda value: f"{value:g} dB".replace("-", "−"), fontsize=6)
        axes.plot([-180.0], [0.0], marker="+", color=DARK, markersize=9, linestyle="none")
        axes.set(
            xlim=(left, right), ylim=(low, high), xlabel=with_unit("phase of L", "deg"), ylabel=with_unit("|L|", "dB")
        )
        _note_ends(axes, loops, names, omega)
        _legend(figure, axes)
    return figure


def step(closed: Sequence[Any], names: Sequence[str], times: ArrayLike | None, horizon: float) -> Figure:
    """Return the step responses of closed loops; see `LoopTransfer.step`."""
    import control

    with style():
        figure = new_figure(3.4)
        axes = figure.subplots()
        end = horizon if times is None else float(np.max(np.asarray(times, dtype=float)))
        if not 0.0 < end < np.inf:
            raise OptionError(f"found {times!r}; expected times in s above 0. Give some.", port="t")
        for i, system in enumerate(closed):
            dt = float(system.dt or 0.0)
            grid = dt * np.arange(int(end / dt * (1 + 1e-9)) + 1) if dt else np.linspace(0.0, end, POINTS)
            found = control.step_response(system, T=grid)
            look = _look(i, system)
            axes.plot(found.t, np.ravel(found.y), label=names[i], drawstyle="steps-post" if dt else "default", **look)
        axes.axhline(1.0, color=GREY, linewidth=0.8, zorder=0)
        axes.set(xlim=(0.0, end), xlabel=with_unit("t", "s"), ylabel="response to a unit step")
        _legend(figure, axes)
    return figure


def four(systems: Sequence[Mapping[str, Any]], names: Sequence[str], omega: ArrayLike | None) -> Figure:
    """Return the gains of S, T, PS and CS; see `LoopTransfer.gang_of_four`."""
    with style():
        figure = new_figure(4.8)
        panels = figure.subplots(2, 2, sharex=True)
        for axes, key in zip(np.ravel(panels), ("S", "PS", "CS", "T"), strict=True):
            own = [found[key] for found in systems]
            spans = _span([found["L"] for found in systems], omega)
            for i, (system, w) in enumerate(zip(own, spans, strict=True)):
                if omega is None:  # closed loops have resonances of their own, up to π/T
                    top = _limit(system) * BELOW if system.dt else float(w[-1])
                    w = Realization.of(system).grid(float(w[0]), top, POINTS)
                axes.plot(w, np.abs(response(system, w)), label=names[i], **_look(i, system))
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.set_ylabel(f"|{key}|")
            if key in ("S", "T"):
                axes.axhline(1.0, color=GREY, linewidth=0.8, zorder=0)
        for axes in panels[1]:
            axes.set_xlabel(with_unit("ω", "rad/s"))
        _note_ends(panels[0, 0], [found["L"] for found in systems], names, omega)
        _legend(figure, panels[0, 0])
    return figure
