"""Figures of a report: Bode, Nyquist, sensitivities, measured responses; drawn without pyplot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ..report_writing import Plot, Texts
from ..results import BLUE, DARK, GREEN, GREY, ORANGE, PURPLE, VERMILION, new_figure, style
from .variant import Implementation

if TYPE_CHECKING:
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
    color, line = LOOKS.get(key, OTHER[i % len(OTHER)])
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
    key: str, wire: str, loops: Mapping[str, Any], found: Mapping[str, Margins], titles: Mapping[str, str]
) -> Plot:
    """Draw L over frequency, with the margins marked."""
    low, high = _span(loops, found)
    with style():
        figure = new_figure(4.4)
        top, bottom = figure.subplots(2, 1, sharex=True)
        for i, (name, L) in enumerate(loops.items()):
            look = look_of(name, i)
            w, value = _response(L, low, high)
            phase = np.degrees(np.unwrap(np.angle(value)))
            phase -= 360 * np.round((phase[0] + 180) / 360)  # the branch that begins nearest to −180°
            top.loglog(w, np.abs(value), label=titles[name], **look)
            bottom.semilogx(w, phase, **look)
            for c in found[name].gain_crossovers:
                x, y = c.frequency.value, np.interp(c.frequency.value, w, phase)
                top.plot(x, 1.0, "o", color=look["color"], markersize=3.5)
                bottom.plot([x, x], [-180, y], color=look["color"], linewidth=2.0, alpha=0.6)
            for p in found[name].phase_crossovers:
                if low < p.frequency.value < high:
                    k = p.gain_margin.value
                    top.plot([p.frequency.value] * 2, [1.0, 1.0 / k], color=look["color"], linewidth=2.0, alpha=0.6)
                    bottom.plot(p.frequency.value, -180, "s", color=look["color"], markersize=3.5)
            if L.dt:
                for ax in (top, bottom):
                    ax.axvline(np.pi / L.dt, color=GREY, linewidth=0.6, linestyle=":")
        top.axhline(1.0, color=DARK, linewidth=0.6)
        bottom.axhline(-180, color=DARK, linewidth=0.6)
        top.set_ylabel("|L|")
        bottom.set_ylabel("phase of L [°]")
        bottom.set_xlabel("ω [rad/s]")
        top.legend(loc="best")
    caption = TEXTS.line("bode", wire=wire)
    return Plot(key, caption, figure)


def nyquist(
    key: str, wire: str, loops: Mapping[str, Any], found: Mapping[str, Margins], titles: Mapping[str, str]
) -> Plot:
    """Draw L in the complex plane near −1, with the disk that it keeps away from."""
    low, high = _span(loops, found)
    with style():
        figure = new_figure(4.0)
        ax = figure.subplots()
        angle = np.linspace(0, 2 * np.pi, 361)
        ax.plot(np.cos(angle), np.sin(angle), color=GREY, linewidth=0.6)
        for i, (name, L) in enumerate(loops.items()):
            look = look_of(name, i)
            _, value = _response(L, low, high)
            ax.plot(value.real, value.imag, label=titles[name], **look)
            ax.plot(value.real, -value.imag, color=look["color"], linestyle=look["linestyle"], linewidth=0.5)
            m = found[name]
            if np.isfinite(m.modulus_margin.value):
                r = m.modulus_margin.value
                ax.plot(-1 + r * np.cos(angle), r * np.sin(angle), color=look["color"], linewidth=0.5, linestyle=":")
            for c in m.gain_crossovers:
                ends = np.exp(1j * np.radians(c.phase_margin_deg.value - 180))
                ax.plot([0, ends.real], [0, ends.imag], color=look["color"], linewidth=0.6)
                ax.plot(ends.real, ends.imag, "o", color=look["color"], markersize=3.5)
        ax.plot(-1, 0, "+", color=DARK, markersize=9, markeredgewidth=1.4)
        ax.set_aspect("equal")
        ax.set_xlim(-3.2, 1.4)
        ax.set_ylim(-2.0, 2.0)
        ax.set_xlabel("Re L")
        ax.set_ylabel("Im L")
        ax.legend(loc="lower right")
    caption = TEXTS.line("nyquist", wire=wire)
    return Plot(key, caption, figure)


def sensitivities(
    key: str, wire: str, loops: Mapping[str, Any], found: Mapping[str, Margins], titles: Mapping[str, str]
) -> Plot:
    """Draw |S| and |T|."""
    low, high = _span(loops, found)
    with style():
        figure = new_figure(2.7)
        left, right = figure.subplots(1, 2, sharey=True)
        for i, (name, L) in enumerate(loops.items()):
            w, value = _response(L, low, high)
            left.loglog(w, np.abs(1 / (1 + value)), label=titles[name], **look_of(name, i))
            right.loglog(w, np.abs(value / (1 + value)), **look_of(name, i))
            for ax, x, y in ((left, "ms_frequency", "ms"), (right, "mt_frequency", "mt")):
                mark = getattr(found[name], x).value, getattr(found[name], y).value
                if low < mark[0] < high:
                    ax.plot(*mark, "o", color=look_of(name, i)["color"], markersize=3.5)
        for ax, name in ((left, "|S|"), (right, "|T|")):
            ax.axhline(1.0, color=DARK, linewidth=0.6)
            ax.set_title(name)
            ax.set_xlabel("ω [rad/s]")
            ax.set_ylim(bottom=1e-3)
        left.legend(loc="best")
    return Plot(key, TEXTS.line("sensitivities", wire=wire), figure)


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
