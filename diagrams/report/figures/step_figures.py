"""Figures of responses to steps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ....blocks.core import with_unit
from ...plotting import DARK, GREY, legend_above, new_figure, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ...measure import StepResponse


RESTS = 0.02
"""Distance from the last sample, relative to the whole range, within which a response has settled."""
SHOWN = 4.0
"""Length of the time axis at most, in times until all responses have settled: a record may be many times as long."""


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
    end = shown_time(curves, to_output=to_output)
    for name, got in curves.items():
        look, title = looks[name], titles[name]
        begins = int(np.argmax(got.d != 0.0))
        t = got.t - got.t[begins]
        last = int(np.searchsorted(t, end, side="right"))
        few = np.unique(np.linspace(0, last - 1, 40).astype(int))
        y = got.answer(to_output)
        shown = whole * (got.d != 0.0) - y if whole else y
        drawn: dict[str, Any] = {"drawstyle": "steps-post"} if got.held else {}
        ax.plot(t[:last], shown[:last], label=title, **look, **drawn)
        if got.prediction is not None:
            p = got.answer(to_output, linear=True)
            dots = (whole * (got.d != 0.0) - p if whole else p)[few]
            ax.plot(t[few], dots, "o", color=look["color"], markersize=2.5)


def shown_time(curves: Mapping[str, StepResponse], *, to_output: bool) -> float:
    """Return the time in s after a step up to which responses are drawn: some times of that until all of them rest."""
    ends = []
    for got in curves.values():
        t, y = got.t - got.t[int(np.argmax(got.d != 0.0))], got.answer(to_output)
        moving = np.flatnonzero(np.abs(y - y[-1]) > RESTS * np.ptp(y))
        rests = float(t[min(moving[-1] + 1, len(t) - 1)]) if moving.size else 0.0
        ends.append(SHOWN * rests if rests > 0.0 else float(t[-1]))
    return min(max(ends), max(float(got.t[-1] - got.t[int(np.argmax(got.d != 0.0))]) for got in curves.values()))
