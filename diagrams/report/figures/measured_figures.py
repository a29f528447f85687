"""Figures of measured loops over their linear models."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ....blocks.core import with_unit
from ...frequency import DrawnLoop, phase_of
from ...plotting import BLUE, VERMILION, AxisUnits, legend_above, new_figure, set_frequencies, set_magnitudes, style
from ..pages import Plot, Texts

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TEXTS = Texts(__package__, "figures")


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
