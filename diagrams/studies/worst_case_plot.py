"""Scatter of the cases of a worst-case study."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ...blocks.core import OptionError, accepts, kinds, near, with_unit
from ..plotting import BLUE, DARK, GREEN, PURPLE, VERMILION, legend_above, shown_figure
from ..sweeps import Box
from .cases import CaseOrigin, CaseState, Goal, StudyCase

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@accepts("plot", parameters=kinds.names)
def plot_cases(
    cases: Sequence[StudyCase],
    worst: StudyCase,
    goal: Goal,
    boxes: Mapping[str, Box],
    parameters: Sequence[str] | None = None,
    *,
    is_shown: bool = True,
) -> Figure:
    """Return a scatter of the number over each parameter; see `WorstCase.plot`."""
    every = [name for name, value in worst.parameters.items() if isinstance(value, float | int)]
    asked = [parameters] if isinstance(parameters, str) else list(every if parameters is None else parameters)
    names = list[str]()
    for name in asked:
        found = [full for full in every if full == name] or [full for full in every if full.endswith(f".{name}")]
        names += found[:1]
        if len(found) != 1:
            raise OptionError(f"found no parameter {name!r} with one number in the study. {near(name, every)}")
    if not names:
        raise OptionError("found no parameter with one number; expected one to draw over. Look at table().")
    # A worst case without a number is drawn over the goal's first.
    if worst.quantity:
        loop, quantity = worst.loop, worst.quantity
    else:
        loop = next(iter(goal.loops))
        quantity = next(iter(goal.loops[loop]))
    rows, columns = math.ceil(len(names) / 3), min(len(names), 3)
    with shown_figure(0.3 + 2.4 * rows, is_shown=is_shown) as figure:
        grid = figure.subplots(rows, columns, squeeze=False)
        looks = {
            CaseOrigin.SAMPLE: (BLUE, 12, "samples"),
            CaseOrigin.CORNER: (PURPLE, 18, "corners"),
            CaseOrigin.SEARCH: (GREEN, 8, "search"),
        }
        for place, axes in enumerate(grid.flat):
            if place >= len(names):
                axes.set_visible(False)
                continue
            name = names[place]
            for origin, (color, size, label) in looks.items():
                mine = [c for c in cases if c.origin is origin and c.state in (CaseState.STABLE, CaseState.MOVING)]
                mine = [c for c in mine if loop in c.numbers and math.isfinite(c.numbers[loop][quantity].value)]
                if mine:
                    y = [c.numbers[loop][quantity].value for c in mine]
                    axes.scatter([c.parameters[name] for c in mine], y, s=size, color=color, label=label, alpha=0.8)
            bad = [c for c in cases if c.parameters and c.state in (CaseState.UNSTABLE, CaseState.FAILED)]
            # Cases without a number are drawn at the lower edge, where they can't be taken for a small margin's value.
            low = axes.get_ylim()[0] if axes.collections else 0.0
            if bad:
                x = [c.parameters[name] for c in bad]
                axes.scatter(x, np.full(len(bad), low), marker="x", color=VERMILION, s=20, label="unstable or failed")
            y_worst = worst.numbers[loop][quantity].value if loop in worst.numbers else low
            axes.scatter(
                [worst.parameters[name]], [y_worst], marker="*", s=130, color=VERMILION, label="worst", zorder=3
            )
            limit = goal.loops[loop][quantity]
            for end in () if limit is None else limit:
                if math.isfinite(end):
                    axes.axhline(end, color=DARK, linestyle="--", linewidth=0.9)
            if name in boxes and boxes[name].scale == "log":
                axes.set_xscale("log")
            axes.set_xlabel(name if len(name) < 34 else f"…{name[-32:]}")
            if place % 3 == 0:
                unit = next((c.numbers[loop][quantity].unit for c in cases if loop in c.numbers), "1")
                axes.set_ylabel(with_unit(quantity, unit))
        legend_above(figure, grid.flat[0])
    return figure
