"""Figures of loops: Bode, Nyquist, sensitivities, the gang of four; drawn without pyplot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ....blocks.core import with_unit
from ...plotting import DARK, GREY, WIDTH, AxisUnits, legend_above, new_figure, set_frequencies, set_magnitudes, style
from ..pages import Plot, Texts

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ...frequency import Margins

TEXTS = Texts(__package__, "figures")
OFF_THE_PAGE = 1e3
"""Size of L from which on it is not drawn in the complex plane: beyond lies the other branch of a resonance."""


FINEST = 5
"""Smallest step in degrees between the ticks of a phase."""


class DrawnLoops(NamedTuple):
    """Loops at a wire, as their figures draw them: by their keys.

    Attributes
    ----------
    wire : str
        The wire.
    loops : mapping of str to LinearSystem
        L of each.
    found : mapping of str to Margins
        Their margins, which are marked.
    titles : mapping of str to str
        Their names in legends.
    looks : mapping of str to dict
        Colors and lines.
    axes : AxisUnits
        Units of the axes.
    """

    wire: str
    loops: Mapping[str, Any]
    found: Mapping[str, Margins]
    titles: Mapping[str, str]
    looks: Mapping[str, dict[str, Any]]
    axes: AxisUnits


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
    from ...frequency import realize

    r = realize(L)
    w = r.grid(low, high, 600)
    return w, r.response(w)[0]


def bode(key: str, of: DrawnLoops) -> Plot:
    """Draw L over frequency, with the margins marked."""
    return Plot(key, TEXTS.line("bode", wire=of.wire), draw_bode(of, 3.0, WIDTH))


def draw_bode(of: DrawnLoops, height: float, width: float) -> Figure:
    """Return a figure of L over frequency, with the margins marked; its height and width are in inches."""
    low, high = _span(of.loops, of.found)
    is_small = width < WIDTH
    with style():
        figure = new_figure(height, width)
        top, bottom = figure.subplots(2, 1, sharex=True)
        for name, L in of.loops.items():
            look = of.looks[name]
            w, value = _response(L, low, high)
            phase = np.degrees(np.unwrap(np.angle(value)))
            phase -= 360 * np.round((phase[0] + 180) / 360)  # the branch that begins nearest to −180°
            top.semilogx(of.axes.frequency(w), of.axes.magnitude(np.abs(value)), label=of.titles[name], **look)
            bottom.semilogx(of.axes.frequency(w), phase, **look)
            for c in of.found[name].gain_crossovers:
                at = c.frequency.value
                x, y = of.axes.frequency(at), np.interp(at, w, phase)
                top.plot(x, of.axes.magnitude(1.0), "o", color=look["color"], markersize=3.5)
                bottom.plot([x, x], [-180, y], color=look["color"], linewidth=2.0, alpha=0.6)
            for p in of.found[name].phase_crossovers:
                if low < p.frequency.value < high:
                    x, k = of.axes.frequency(p.frequency.value), p.gain_margin.value
                    top.plot([x] * 2, of.axes.magnitude([1.0, 1.0 / k]), color=look["color"], linewidth=2.0, alpha=0.6)
                    bottom.plot(x, -180, "s", color=look["color"], markersize=3.5)
            if L.dt:
                for ax in (top, bottom):
                    ax.axvline(of.axes.frequency(np.pi / L.dt), color=GREY, linewidth=0.6, linestyle=":")
        set_magnitudes(top, of.axes, 5 if is_small else 6)
        top.axhline(of.axes.magnitude(1.0), color=DARK, linewidth=0.6)
        bottom.axhline(-180, color=DARK, linewidth=0.6)
        set_degrees(bottom, few=is_small)
        set_frequencies(bottom, 5 if is_small else 9)
        top.set_ylabel(of.axes.magnitude_label("|L|"))
        bottom.set_ylabel(with_unit("phase" if is_small else "phase of L", "deg"))
        bottom.set_xlabel(of.axes.frequency_label)
        legend_above(figure, top)
    return figure


def set_degrees(ax: Axes, *, few: bool) -> None:
    """Set ticks of a phase at multiples of 45° or 90°; at few of them in a small figure."""
    from matplotlib.ticker import MultipleLocator

    low, high = ax.get_ylim()
    steps = {200: 90, 600: 180} if few else {300: 45, 600: 90, 1400: 180}
    step = next((step for span, step in steps.items() if high - low < span), 360)
    while step > FINEST and np.floor(high / step) - np.ceil(low / step) < 1:  # a scale has two labels
        step = next(finer for finer in (90, 45, 15, FINEST) if finer < step)
    ax.yaxis.set_major_locator(MultipleLocator(step, 180 if step == 360 else 0))  # −180° has a tick


def nyquist(key: str, of: DrawnLoops) -> Plot:
    """Draw L in the complex plane: near −1, and beside it so far that all crossings of the real axis are in view."""
    low, high = _span(of.loops, of.found)
    crossings = [-1 / p.gain_margin.value for m in of.found.values() for p in m.phase_crossovers if p.gain_margin.value]
    farthest = min([-1.0, *(x for x in crossings if np.isfinite(x))])
    with style():
        figure = new_figure(2.9)
        panels = figure.subplots(1, 2 if farthest < NEAR[0] else 1, squeeze=False)[0]
        for ax in panels:
            _draw_nyquist(ax, of, low, high)
        near = panels[-1]
        near.set_xlim(*NEAR)
        near.set_ylim(-1.7, 1.7)
        if len(panels) > 1:
            span = 1.25 * abs(farthest)
            panels[0].set_xlim(-span, 0.35 * span)
            panels[0].set_ylim(-0.675 * span, 0.675 * span)
            panels[0].set_title("all crossings")
            near.set_title("near −1")
        legend_above(figure, panels[0])
    caption = TEXTS.line("nyquist", wire=of.wire)
    return Plot(key, caption, figure)


NEAR = (-2.6, 1.4)
"""Real parts that are drawn near −1."""


def _draw_nyquist(ax: Axes, of: DrawnLoops, low: float, high: float) -> None:
    angle = np.linspace(0, 2 * np.pi, 361)
    ax.plot(np.cos(angle), np.sin(angle), color=GREY, linewidth=0.6)
    for name, L in of.loops.items():
        look = of.looks[name]
        _, value = _response(L, low / 10, high)
        far = [abs(10 / p.gain_margin.value) for p in of.found[name].phase_crossovers if p.gain_margin.value]
        value = np.where(np.abs(value) < max([OFF_THE_PAGE, *far]), value, np.nan)
        ax.plot(value.real, value.imag, label=of.titles[name], **look)
        ax.plot(value.real, -value.imag, color=look["color"], linestyle=look["linestyle"], linewidth=0.5)
        _arrows(ax, value, look["color"])
        m = of.found[name]
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
        far = np.abs(np.log(np.maximum(np.abs(value), 1e-300) / size))
        k = int(np.argmin(np.where(np.isnan(far), np.inf, far)))
        if 0 < k < len(value) - 1 and far[k] < 0.2 and np.isfinite(value[k + 1]):
            ends = [(float(z.real), float(z.imag)) for z in value[[k, k + 1]]]
            arrow = {"arrowstyle": "-|>", "color": color, "linewidth": 0.8}
            ax.annotate("", xy=ends[1], xytext=ends[0], arrowprops=arrow, annotation_clip=True)


def sensitivities(key: str, of: DrawnLoops) -> Plot:
    """Draw |S| and |T|."""
    low, high = _span(of.loops, of.found)
    with style():
        figure = new_figure(2.1)
        left, right = figure.subplots(1, 2, sharey=True)
        for name, L in of.loops.items():
            w, value = _response(L, low, high)
            x, look = of.axes.frequency(w), of.looks[name]
            left.semilogx(x, of.axes.magnitude(np.abs(1 / (1 + value))), label=of.titles[name], **look)
            right.semilogx(x, of.axes.magnitude(np.abs(value / (1 + value))), **look)
            for ax, place, peak in ((left, "ms_frequency", "ms"), (right, "mt_frequency", "mt")):
                at, size = getattr(of.found[name], place).value, getattr(of.found[name], peak).value
                if low < at < high:
                    ax.plot(of.axes.frequency(at), of.axes.magnitude(size), "o", color=look["color"], markersize=3.5)
        for ax, name in ((left, "|S|"), (right, "|T|")):
            set_magnitudes(ax, of.axes)
            ax.axhline(of.axes.magnitude(1.0), color=DARK, linewidth=0.6)
            ax.set_title(of.axes.magnitude_label(name))
            ax.set_xlabel(of.axes.frequency_label)
            set_frequencies(ax)
            ax.set_ylim(bottom=of.axes.magnitude(1e-3))
        legend_above(figure, left)
    return Plot(key, TEXTS.line("sensitivities", wire=of.wire), figure)


def gang(
    key: str,
    curves: Mapping[str, tuple[str, np.ndarray, np.ndarray, np.ndarray]],
    wire: str,
    other: str,
    axes: AxisUnits,
    looks: Mapping[str, dict[str, Any]],
) -> Plot:
    """Draw the responses from a disturbance at a wire to the next one on the loop, and from there back."""
    with style():
        figure = new_figure(2.1)
        left, right = figure.subplots(1, 2)
        for name, (title, w, there, back) in curves.items():
            look = looks[name]
            left.semilogx(axes.frequency(w), axes.magnitude(there), label=title, **look)
            right.semilogx(axes.frequency(w), axes.magnitude(back), **look)
        for ax, name in ((left, f"|PS|: {wire} to {other}"), (right, f"|CS|: {other} to {wire}")):
            set_magnitudes(ax, axes)
            set_frequencies(ax)
            ax.set_title(axes.magnitude_label(name), fontsize="small")
            ax.set_xlabel(axes.frequency_label)
        legend_above(figure, left)
    return Plot(key, TEXTS.line("gang", wire=wire, other=other), figure)


def response(L: Any, w: np.ndarray) -> np.ndarray:
    """Return the response of a loop with one channel at frequencies."""
    from ...frequency import realize

    return realize(L).response(w)[0]
