"""Figures of admittances and stability maps, drawn without pyplot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ...blocks.core import with_unit
from ..report import Plot, Texts, fill_growth, look_of, set_powers, tint
from ..results import DARK, VERMILION, legend_above, new_figure, style

TEXTS = Texts(__package__, "admittance")
TARGET, RULE = "target", "rule_of_thumb"
"""Curves besides those of variants."""
DOTTED: Mapping[str, Any] = {"color": DARK, "linestyle": (0, (1, 1.5)), "linewidth": 1.6}


def draw_admittances(
    key: str,
    w: np.ndarray,
    curves: Mapping[str, tuple[str, np.ndarray]],
    looks: Mapping[str, dict[str, Any]],
    *,
    along: bool,
) -> Plot:
    """Draw target and rendered admittances: magnitude, phase, and where the real part is negative.

    Parameters
    ----------
    key : str
        Key of the figure.
    w : ndarray
        Frequencies in rad/s.
    curves : mapping of str to (str, ndarray)
        Title and values of each: of `TARGET`, and of variants by their keys.
    looks : mapping of str to dict
        Color and line of each variant, as of `Case.looks`.
    along : bool
        Whether it is the direction along the path.
    """
    with style():
        figure = new_figure(3.2)
        top, bottom = figure.subplots(2, 1, sharex=True)
        for i, (name, (title, Y)) in enumerate(curves.items()):
            look = DOTTED if name == TARGET else looks.get(name) or look_of(name, i)
            top.loglog(w, np.abs(Y), label=title, **look)
            bottom.semilogx(w, np.degrees(np.angle(Y)), **look)
        for y in (-90, 90):
            bottom.axhline(y, color=DARK, linewidth=0.6)
        bottom.axhspan(90, 180, color=tint(VERMILION, 0.07), linewidth=0, zorder=0)
        bottom.axhspan(-180, -90, color=tint(VERMILION, 0.07), linewidth=0, zorder=0)
        bottom.set_ylim(-180, 180)
        bottom.set_yticks([-180, -90, 0, 90, 180])
        top.set_ylabel(with_unit("|Y|", "m/(N.s)"))
        bottom.set_ylabel(with_unit("phase of Y", "deg"))
        bottom.set_xlabel(with_unit("ω", "rad/s"))
        set_powers(bottom.xaxis, bottom.get_xlim(), 9)
        set_powers(top.yaxis, top.get_ylim(), 6)
        legend_above(figure, top)
    return Plot(key, TEXTS.line("rendered", along=along), figure)


def draw_stability(
    key: str,
    k: np.ndarray,
    b: np.ndarray,
    growth: np.ndarray,
    lines: Mapping[str, tuple[str, np.ndarray]],
    looks: Mapping[str, dict[str, Any]],
    *,
    along: bool,
) -> Plot:
    """Draw a stability map: growth rates, and the limits of several variants.

    Parameters
    ----------
    key : str
        Key of the figure.
    k, b : ndarray
        Stiffness in N/m and damping in N·s/m of the environment.
    growth : ndarray
        Growth rates in 1/s, for each damping and stiffness.
    lines : mapping of str to (str, ndarray)
        Title and stiffness of each limit: of variants by their keys, and the `RULE` of thumb.
    looks : mapping of str to dict
        Color and line of each variant, as of `Case.looks`.
    along : bool
        Whether it is the direction along the path.
    """
    with style():
        figure = new_figure(2.9)
        ax = figure.subplots()
        fill_growth(ax, k, b, growth, least=-100.0)
        for name, (title, x) in lines.items():
            ax.plot(x, b, label=title, **(DOTTED if name == RULE else looks.get(name, {})))
        legend_above(figure, ax)
    return Plot(key, TEXTS.line("map", along=along), figure)
