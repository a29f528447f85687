"""Figures of responses to steps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ....blocks.core import with_unit
from ...results import DARK, GREY, legend_above, new_figure, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ...measure import StepResponse


def draw_answer(
    curves: Mapping[str, StepResponse],
    looks: Mapping[str, dict[str, Any]],
    height: float,
    width: float,
    *,
    to_output: bool,
) -> Figure:
    """Return a figure of the answers to a step alone; its height and width are in inches."""
    with style():
        figure = new_figure(height, width)
        ax = figure.subplots()
        _draw(ax, curves, dict.fromkeys(curves, ""), looks, 0.0, to_output=to_output)
        ax.set_ylabel("answer / step")
        ax.set_xlabel(with_unit("time since the step", "s"))
        ax.axhline(0.0, color=DARK, linewidth=0.6)
        if not to_output:
            ax.axhline(1.0, color=GREY, linewidth=0.6, linestyle=":")
    return figure


def step_responses(
    curves: Mapping[str, StepResponse],
    titles: Mapping[str, str],
    looks: Mapping[str, dict[str, Any]],
    *,
    to_output: bool,
) -> Figure:
    """Draw responses to a step: the answer, and of a loop's own wire what is left of a disturbance."""
    with style():
        figure = new_figure(2.3)
        axes = figure.subplots(1, 1 if to_output else 2, squeeze=False)[0]
        for ax, whole in zip(axes, (0.0, 1.0), strict=False):
            _draw(ax, curves, titles, looks, whole, to_output=to_output)
        for ax, name in zip(axes, ("answer, per unit of the step", "rest of a disturbance"), strict=False):
            ax.set_title(name)
            ax.set_xlabel(with_unit("time since the step", "s"))
            ax.axhline(0.0, color=DARK, linewidth=0.6)
        if not to_output:
            axes[0].axhline(1.0, color=GREY, linewidth=0.6, linestyle=":")
        legend_above(figure, axes[0])
    return figure


def _draw(
    ax: Axes,
    curves: Mapping[str, StepResponse],
    titles: Mapping[str, str],
    looks: Mapping[str, dict[str, Any]],
    whole: float,
    *,
    to_output: bool,
) -> None:
    """Draw the answers, or with a whole of 1 what is left of the step, with the linear model's as dots."""
    for name, got in curves.items():
        look, title = looks[name], titles[name]
        begins = int(np.argmax(got.d != 0.0))
        t = got.t - got.t[begins]
        few = np.unique(np.linspace(0, len(t) - 1, 40).astype(int))
        y = got.answer(to_output)
        shown = whole * (got.d != 0.0) - y if whole else y
        drawn: dict[str, Any] = {"drawstyle": "steps-post"} if got.held else {}
        ax.plot(t, shown, label=title, **look, **drawn)
        if got.prediction is not None:
            p = got.answer(to_output, linear=True)
            dots = (whole * (got.d != 0.0) - p if whole else p)[few]
            ax.plot(t[few], dots, "o", color=look["color"], markersize=2.5)
