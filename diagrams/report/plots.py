"""Figures of a report: Bode, Nyquist, sensitivities, measured responses; drawn without pyplot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ..report_writing import Plot, Texts
from ..results import BLUE, DARK, GREEN, GREY, ORANGE, PURPLE, VERMILION, new_figure, style
from .case import AxisUnits
from .variant import Implementation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..frequency import Margins
    from ..measure import StepResponse

TEXTS = Texts(__package__, "figures")
LOOKS: Mapping[str, tuple[str, Any]] = {
    Implementation.CONTINUOUS: (GREY, "-"),
    Implementation.SAMPLED: (BLUE, "-"),
    Implementation.DELAYED: (VERMILION, (0, (4, 2))),
}
OTHER = ((GREEN, "-"), (ORANGE, (0, (4, 2))), (PURPLE, (0, (1, 1.5))))


def look_of(key: str, i: int) -> dict[str, Any]:
    """Return the color and line of a variant, or of the i-th other curve."""
    color, line = LOOKS.get(key) or OTHER[i % len(OTHER)]
    if i == 0:  # the diagram as it is, or the first of others
        return {"color": color, "linestyle": "-", "linewidth": 1.7, "zorder": 3}
    return {"color": color, "linestyle": line}


def _span(loops: Mapping[str, Any], found: Mapping[str, Margins]) -> tuple[float, float]:
    """Return the frequencies that matter: a decade and a half around the crossings."""
    marks = [c.frequency.value for m in found.values() for c in m.gain_crossovers]
    marks += [p.frequency.value for m in found.values() for p in m.phase_crossovers]
    marks = [w for w in marks if 0 < w < np.inf]
    tops = [np.pi / L.dt for L in loops.values() if L.dt]
    low = min(marks, default=1.0) / 30
    high = max([10 * max(marks, default=100.0), *tops])
    return low, high


def _response(L: Any, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    from ..frequency import Realization

    top = min(high, np.pi / L.dt * (1 - 1e-6)) if L.dt else high
    w = np.geomspace(low, top, 600)
    return w, Realization.of(L).response(w)[0]


def bode(
    key: str,
    wire: str,
    loops: Mapping[str, Any],
    found: Mapping[str, Margins],
    titles: Mapping[str, str],
    axes: AxisUnits,
) -> Plot:
    """Draw L over frequency, with the margins marked."""
    low, high = _span(loops, found)
    with style():
        figure = new_figure(4.0)
        top, bottom = figure.subplots(2, 1, sharex=True)
        for i, (name, L) in enumerate(loops.items()):
            look = look_of(name, i)
            w, value = _response(L, low, high)
            phase = np.degrees(np.unwrap(np.angle(value)))
            phase -= 360 * np.round((phase[0] + 180) / 360)  # the branch that begins nearest to −180°
            top.semilogx(axes.frequency(w), axes.magnitude(np.abs(value)), label=titles[name], **look)
            bottom.semilogx(axes.frequency(w), phase, **look)
            for c in found[name].gain_crossovers:
                at = c.frequency.value
                x, y = axes.frequency(at), np.interp(at, w, phase)
                top.plot(x, axes.magnitude(1.0), "o", color=look["color"], markersize=3.5)
                bottom.plot([x, x], [-180, y], color=look["color"], linewidth=2.0, alpha=0.6)
            for p in found[name].phase_crossovers:
                if low < p.frequency.value < high:
                    x, k = axes.frequency(p.frequency.value), p.gain_margin.value
                    top.plot([x] * 2, axes.magnitude([1.0, 1.0 / k]), color=look["color"], linewidth=2.0, alpha=0.6)
                    bottom.plot(x, -180, "s", color=look["color"], markersize=3.5)
            if L.dt:
                for ax in (top, bottom):
                    ax.axvline(axes.frequency(np.pi / L.dt), color=GREY, linewidth=0.6, linestyle=":")
        _scale(top, axes)
        top.axhline(axes.magnitude(1.0), color=DARK, linewidth=0.6)
        bottom.axhline(-180, color=DARK, linewidth=0.6)
        _degrees(bottom)
        top.set_ylabel(axes.magnitude_label("|L|"))
        bottom.set_ylabel("phase of L [°]")
        bottom.set_xlabel(axes.frequency_label)
        top.legend(loc="best")
    caption = TEXTS.line("bode", wire=wire)
    return Plot(key, caption, figure)


def _scale(ax: Axes, axes: AxisUnits) -> None:
    """Set the scale of a magnitude's axis, with few ticks."""
    from matplotlib.ticker import LogLocator, MaxNLocator

    if axes.decibels:
        ax.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 4, 5, 10]))
    else:
        ax.set_yscale("log")
        ax.yaxis.set_major_locator(LogLocator(numticks=6))


def _degrees(ax: Axes) -> None:
    """Set ticks of a phase at multiples of 45° or 90°."""
    from matplotlib.ticker import MultipleLocator

    low, high = ax.get_ylim()
    ax.yaxis.set_major_locator(MultipleLocator(45 if high - low < 300 else 90 if high - low < 700 else 360))


def nyquist(
    key: str, wire: str, loops: Mapping[str, Any], found: Mapping[str, Margins], titles: Mapping[str, str]
) -> Plot:
    """Draw L in the complex plane: near −1, and beside it so far that all crossings of the real axis are in view."""
    low, high = _span(loops, found)
    crossings = [-1 / p.gain_margin.value for m in found.values() for p in m.phase_crossovers if p.gain_margin.value]
    farthest = min([-1.0, *(x for x in crossings if np.isfinite(x))])
    with style():
        figure = new_figure(3.3)
        panels = figure.subplots(1, 2 if farthest < NEAR[0] else 1, squeeze=False)[0]
        for ax in panels:
            _draw_nyquist(ax, loops, found, titles, low, high)
        near = panels[-1]
        near.set_xlim(*NEAR)
        near.set_ylim(-1.7, 1.7)
        if len(panels) > 1:
            span = 1.25 * abs(farthest)
            panels[0].set_xlim(-span, 0.35 * span)
            panels[0].set_ylim(-0.675 * span, 0.675 * span)
            panels[0].set_title("all crossings")
            near.set_title("near −1")
        panels[0].legend(loc="lower left", fontsize="small")
    caption = TEXTS.line("nyquist", wire=wire)
    return Plot(key, caption, figure)


NEAR = (-2.6, 1.4)
"""Real parts that are drawn near −1."""


def _draw_nyquist(
    ax: Axes,
    loops: Mapping[str, Any],
    found: Mapping[str, Margins],
    titles: Mapping[str, str],
    low: float,
    high: float,
) -> None:
    angle = np.linspace(0, 2 * np.pi, 361)
    ax.plot(np.cos(angle), np.sin(angle), color=GREY, linewidth=0.6)
    for i, (name, L) in enumerate(loops.items()):
        look = look_of(name, i)
        _, value = _response(L, low / 10, high)
        ax.plot(value.real, value.imag, label=titles[name], **look)
        ax.plot(value.real, -value.imag, color=look["color"], linestyle=look["linestyle"], linewidth=0.5)
        _arrows(ax, value, look["color"])
        m = found[name]
        if np.isfinite(m.modulus_margin.value):
            r = m.modulus_margin.value
            ax.plot(-1 + r * np.cos(angle), r * np.sin(angle), color=look["color"], linewidth=0.5, linestyle=":")
        for c in m.gain_crossovers:
            ends = np.exp(1j * np.radians(c.phase_margin_deg.value - 180))
            ax.plot([0, ends.real], [0, ends.imag], color=look["color"], linewidth=0.6)
            ax.plot(ends.real, ends.imag, "o", color=look["color"], markersize=3.5)
        for p in m.phase_crossovers:
            if p.gain_margin.value:
                ax.plot(-1 / p.gain_margin.value, 0, "s", color=look["color"], markersize=3.0)
    ax.plot(-1, 0, "+", color=DARK, markersize=9, markeredgewidth=1.4)
    ax.set_aspect("equal")
    ax.set_xlabel("Re L")
    ax.set_ylabel("Im L")


def _arrows(ax: Axes, value: np.ndarray, color: str) -> None:
    """Draw arrowheads in the direction of rising frequency, where L has sizes that both panels show."""
    for size in (0.7, 1.5, 6.0):
        k = int(np.argmin(np.abs(np.log(np.maximum(np.abs(value), 1e-300) / size))))
        if 0 < k < len(value) - 1 and abs(np.log(abs(value[k]) / size)) < 0.2:
            ends = [(float(z.real), float(z.imag)) for z in value[[k, k + 1]]]
            arrow = {"arrowstyle": "-|>", "color": color, "linewidth": 0.8}
            ax.annotate("", xy=ends[1], xytext=ends[0], arrowprops=arrow, annotation_clip=True)


def sensitivities(
    key: str,
    wire: str,
    loops: Mapping[str, Any],
    found: Mapping[str, Margins],
    titles: Mapping[str, str],
    axes: AxisUnits,
) -> Plot:
    """Draw |S| and |T|."""
    low, high = _span(loops, found)
    with style():
        figure = new_figure(2.5)
        left, right = figure.subplots(1, 2, sharey=True)
        for i, (name, L) in enumerate(loops.items()):
            w, value = _response(L, low, high)
            x, look = axes.frequency(w), look_of(name, i)
            left.semilogx(x, axes.magnitude(np.abs(1 / (1 + value))), label=titles[name], **look)
            right.semilogx(x, axes.magnitude(np.abs(value / (1 + value))), **look)
            for ax, place, peak in ((left, "ms_frequency", "ms"), (right, "mt_frequency", "mt")):
                at, size = getattr(found[name], place).value, getattr(found[name], peak).value
                if low < at < high:
                    ax.plot(axes.frequency(at), axes.magnitude(size), "o", color=look["color"], markersize=3.5)
        for ax, name in ((left, "|S|"), (right, "|T|")):
            _scale(ax, axes)
            ax.axhline(axes.magnitude(1.0), color=DARK, linewidth=0.6)
            ax.set_title(axes.magnitude_label(name))
            ax.set_xlabel(axes.frequency_label)
            _few_decades(ax)
            ax.set_ylim(bottom=axes.magnitude(1e-3))
        left.legend(loc="best")
    return Plot(key, TEXTS.line("sensitivities", wire=wire), figure)


def _few_decades(ax: Axes) -> None:
    """Set few ticks on the frequency axis of a narrow figure, so that none overlap."""
    from matplotlib.ticker import LogLocator

    ax.xaxis.set_major_locator(LogLocator(numticks=5))


def gang(
    curves: Mapping[str, tuple[str, np.ndarray, np.ndarray, np.ndarray]], wire: str, other: str, axes: AxisUnits
) -> Figure:
    """Draw the responses from a disturbance at a wire to the next one on the loop, and from there back."""
    with style():
        figure = new_figure(2.5)
        left, right = figure.subplots(1, 2)
        for i, (name, (title, w, there, back)) in enumerate(curves.items()):
            look = look_of(name, i)
            left.semilogx(axes.frequency(w), axes.magnitude(there), label=title, **look)
            right.semilogx(axes.frequency(w), axes.magnitude(back), **look)
        for ax, name in ((left, f"|PS|: {wire} to {other}"), (right, f"|CS|: {other} to {wire}")):
            _scale(ax, axes)
            _few_decades(ax)
            ax.set_title(axes.magnitude_label(name), fontsize="small")
            ax.set_xlabel(axes.frequency_label)
        left.legend(loc="best")
    return figure


def response(L: Any, w: np.ndarray) -> np.ndarray:
    """Return the response of a loop with one channel at frequencies."""
    from ..frequency import Realization

    return Realization.of(L).response(w)[0]


def injected(key: str, wire: str, curves: Mapping[str, tuple[np.ndarray, ...]]) -> Plot:
    """Draw measured points over linear models."""
    with style():
        figure = new_figure(2.9)
        left, right = figure.subplots(1, 2)
        for color, (title, (w, value, omega, points)) in zip((BLUE, VERMILION, GREEN), curves.items(), strict=False):
            left.loglog(w, np.abs(value), color=color, label=title)
            left.loglog(omega, np.abs(points), "o", color=color, markersize=3.5)
            right.semilogx(w, np.degrees(np.unwrap(np.angle(value))), color=color)
            phase = np.degrees(np.angle(points))
            near = np.interp(omega, w, np.degrees(np.unwrap(np.angle(value))))
            right.semilogx(omega, phase + 360 * np.round((near - phase) / 360), "o", color=color, markersize=3.5)
        left.set_ylabel("|L|")
        right.set_ylabel("phase of L [°]")
        for ax in (left, right):
            ax.set_xlabel("ω [rad/s]")
        left.legend(loc="best")
    return Plot(key, TEXTS.line("injected", wire=wire), figure)


def step_responses(curves: Mapping[str, StepResponse], *, to_output: bool) -> Figure:
    """Draw responses to a step: the answer, and of a loop's own wire what is left of a disturbance."""
    with style():
        figure = new_figure(2.9)
        axes = figure.subplots(1, 1 if to_output else 2, squeeze=False)[0]
        for color, (title, got) in zip((BLUE, VERMILION, GREEN, PURPLE), curves.items(), strict=False):
            begins = int(np.argmax(got.d != 0.0))
            t = got.t - got.t[begins]
            few = np.unique(np.linspace(0, len(t) - 1, 40).astype(int))
            for ax, whole in zip(axes, (0.0, 1.0), strict=False):
                y = got.answer(to_output)
                shown = whole * (got.d != 0.0) - y if whole else y
                ax.step(t, shown, where="post", color=color, label=title) if got.held else ax.plot(
                    t, shown, color=color, label=title
                )
                if got.prediction is not None:
                    p = got.answer(to_output, linear=True)
                    dots = (whole * (got.d != 0.0) - p if whole else p)[few]
                    ax.plot(t[few], dots, "o", color=color, markersize=2.5)
        for ax, name in zip(axes, ("answer per unit of the step", "left of a disturbance"), strict=False):
            ax.set_title(name)
            ax.set_xlabel("time since the step [s]")
            ax.axhline(0.0, color=DARK, linewidth=0.6)
        if not to_output:
            axes[0].axhline(1.0, color=GREY, linewidth=0.6, linestyle=":")
        axes[0].legend(loc="best")
    return figure
