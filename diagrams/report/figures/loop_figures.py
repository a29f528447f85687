"""Figures of loops: Bode, Nyquist, sensitivities, the gang of four, and measured ones; drawn without pyplot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ....blocks.core import with_unit
from ...frequency import DrawnLoop, draw_bode_axes, draw_nyquist_axes, phase_of
from ...plotting import (
    BLUE,
    DARK,
    VERMILION,
    WIDTH,
    AxisUnits,
    legend_above,
    new_figure,
    set_frequencies,
    set_magnitudes,
    style,
)
from ..pages import Plot, Texts

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ...frequency import Margins

TEXTS = Texts(__package__, "figures")


class DrawnLoops(NamedTuple):
    """Loops at a wire, as their figures draw them: by their keys."""

    wire: str
    loops: Mapping[str, Any]
    found: Mapping[str, Margins]
    titles: Mapping[str, str]
    looks: Mapping[str, dict[str, Any]]
    axes: AxisUnits

    def drawn(self, low: float, high: float) -> list[DrawnLoop]:
        """Return the loops with their responses between two frequencies in rad/s."""
        return [
            DrawnLoop(
                self.titles[name], *_response(L, low, high), self.looks[name], self.found[name], float(L.dt or 0.0)
            )
            for name, L in self.loops.items()
        ]


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
    return Plot(key, TEXTS.line("bode", wire=of.wire), lambda: draw_bode(of, 3.0, WIDTH))


def draw_bode(of: DrawnLoops, height: float, width: float) -> Figure:
    """Return a figure of L over frequency, with the margins marked; its height and width are in inches."""
    low, high = _span(of.loops, of.found)
    with style():
        figure = new_figure(height, width)
        top, bottom = figure.subplots(2, 1, sharex=True)
        draw_bode_axes(top, bottom, of.drawn(low, high), of.axes, few=width < WIDTH)
        legend_above(figure, top)
    return figure


def nyquist(key: str, of: DrawnLoops) -> Plot:
    """Draw L in the complex plane: near −1, and next to it so far that all crossings of the real axis are in view."""
    return Plot(key, TEXTS.line("nyquist", wire=of.wire), lambda: _draw_nyquist(of))


def _draw_nyquist(of: DrawnLoops) -> Figure:
    low, high = _span(of.loops, of.found)
    crossings = [-1 / p.gain_margin.value for m in of.found.values() for p in m.phase_crossovers if p.gain_margin.value]
    farthest = min([-1.0, *(x for x in crossings if np.isfinite(x))])
    drawn = of.drawn(low / 10, high)
    with style():
        figure = new_figure(2.9)
        panels = figure.subplots(1, 2 if farthest < NEAR[0] else 1, squeeze=False)[0]
        for ax in panels:
            draw_nyquist_axes(ax, drawn)
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
    return figure


NEAR = (-2.6, 1.4)
"""Real parts that are drawn near −1."""


def sensitivities(key: str, of: DrawnLoops) -> Plot:
    """Draw |S| and |T|."""
    return Plot(key, TEXTS.line("sensitivities", wire=of.wire), lambda: _draw_sensitivities(of))


def _draw_sensitivities(of: DrawnLoops) -> Figure:
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
    return figure


def gang(
    key: str,
    curves: Mapping[str, tuple[str, np.ndarray, np.ndarray, np.ndarray]],
    wire: str,
    other: str,
    axes: AxisUnits,
    looks: Mapping[str, dict[str, Any]],
) -> Plot:
    """Draw the responses from a disturbance at a wire to the next one on the loop, and from there back."""

    def draw() -> Figure:
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
        return figure

    return Plot(key, TEXTS.line("gang", wire=wire, other=other), draw)


def response(L: Any, w: np.ndarray) -> np.ndarray:
    """Return the response of a loop with one channel at frequencies."""
    from ...frequency import realize

    return realize(L).response(w)[0]


class MeasuredCurve(NamedTuple):
    """Measured points of a loop over its linear model: frequencies in rad/s and values of both."""

    title: str
    w: np.ndarray
    model: np.ndarray
    omega: np.ndarray
    points: np.ndarray
    uncertainty: np.ndarray | None = None
    """Relative uncertainty of each point."""


def injected(
    wire: str, curves: Mapping[str, MeasuredCurve], axes: AxisUnits, looks: Mapping[str, dict[str, Any]], key: str
) -> Plot:
    """Draw points that were measured in the running co-simulation over linear models, each in its variant's color."""

    def draw() -> Figure:
        with style():
            figure = new_figure(2.3)
            left, right = figure.subplots(1, 2)
            for name, curve in curves.items():
                _draw_measured(left, right, curve, axes, looks[name], looks[name]["color"])
            _label_measured(left, right, axes)
            legend_above(figure, left)
        return figure

    return Plot(key, TEXTS.line("injected", wire=wire), draw)


def measured(key: str, wire: str, curve: MeasuredCurve, axes: AxisUnits) -> Plot:
    """Draw points that were measured elsewhere, with their uncertainty, over the linear model in another color."""

    def draw() -> Figure:
        with style():
            figure = new_figure(2.3)
            left, right = figure.subplots(1, 2)
            _draw_measured(left, right, curve, axes, {"color": BLUE}, VERMILION, measured="measured")
            _label_measured(left, right, axes)
            legend_above(figure, left)
        return figure

    return Plot(key, TEXTS.line("measured", wire=wire, bars=curve.uncertainty is not None), draw)


def _draw_measured(
    left: Axes, right: Axes, curve: MeasuredCurve, axes: AxisUnits, look: dict[str, Any], color: Any, measured: str = ""
) -> None:
    """Draw a model as a line and measured points over it, the points' phase on the model's branch."""
    x, at = axes.frequency(curve.w), axes.frequency(curve.omega)
    size = np.abs(curve.points)
    if len(curve.w):
        left.semilogx(x, axes.magnitude(np.abs(curve.model)), label=curve.title, **look)
        phase = phase_of(DrawnLoop(curve.title, curve.w, curve.model, look))
        right.semilogx(x, phase, **look)
    given = np.degrees(np.unwrap(np.angle(curve.points)))
    near = np.interp(curve.omega, curve.w, phase) if len(curve.w) else given
    given = np.degrees(np.angle(curve.points))
    given = given + 360 * np.round((near - given) / 360)
    dots = {"marker": "o", "linestyle": "none", "color": color, "markersize": 3.5, "zorder": 4}
    left.semilogx(at, axes.magnitude(size), label=measured or None, **dots)
    right.semilogx(at, given, **dots)
    if curve.uncertainty is not None:
        r = np.minimum(curve.uncertainty, 0.999)
        turn = np.degrees(np.arcsin(r))
        bars = {"color": color, "linewidth": 0.8, "alpha": 0.6}
        left.vlines(at, axes.magnitude(size * (1 - r)), axes.magnitude(size * (1 + r)), **bars)
        right.vlines(at, given - turn, given + turn, **bars)


def _label_measured(left: Axes, right: Axes, axes: AxisUnits) -> None:
    set_magnitudes(left, axes)
    left.set_ylabel(axes.magnitude_label("|L|"))
    right.set_ylabel(with_unit("phase of L", "deg"))
    for ax in (left, right):
        ax.set_xlabel(axes.frequency_label)
        set_frequencies(ax)
