"""Figures of contacts: admittances, and growth rates over properties of the environment."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from ....blocks.core import with_unit
from ...plotting import BLUE, DARK, VERMILION, legend_above, new_figure, set_frequencies, set_powers, style
from ..pages import Plot, Texts

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TEXTS = Texts(__package__, "figures")


def level_text(value: float, position: int | None = None) -> str:
    """Return a level of a color bar in plain characters, with a minus that is one."""
    return f"{value:g}".replace("-", "−")


DOTTED: Mapping[str, Any] = {"color": DARK, "linestyle": (0, (1, 1.5)), "linewidth": 1.6}
"""Look of a target next to what is rendered."""


def draw_admittances(w: np.ndarray, curves: Iterable[tuple[str, np.ndarray, Mapping[str, Any]]]) -> Figure:
    """Draw admittances over ω in rad/s, with their titles and looks: magnitude, phase, and where Re Y < 0."""
    with style():
        figure = new_figure(3.2)
        top, bottom = figure.subplots(2, 1, sharex=True)
        for title, Y, look in curves:
            top.loglog(w, np.abs(Y), label=title, **look)
            bottom.semilogx(w, np.degrees(np.angle(Y)), **look)
        for y in (-90, 90):
            bottom.axhline(y, color=DARK, linewidth=0.6)
        for low in (90, -180):
            bottom.axhspan(low, low + 90, color=tint(VERMILION, 0.07), linewidth=0, zorder=0)
        bottom.set_ylim(-180, 180)
        bottom.set_yticks([-180, -90, 0, 90, 180])
        top.set_ylabel(with_unit("|Y|", "m/(N.s)"))
        bottom.set_ylabel(with_unit("phase of Y", "deg"))
        bottom.set_xlabel(with_unit("ω", "rad/s"))
        set_frequencies(bottom, 9)
        set_powers(top.yaxis, top.get_ylim(), 6)
        legend_above(figure, top)
    return figure


def contact_admittance(
    key: str, name: str, w: np.ndarray, rendered: np.ndarray, target: np.ndarray | None = None
) -> Plot:
    """Draw the admittance of a contact over ω in rad/s, and that of its filter: magnitude and phase."""
    filtered = [] if target is None else [("filter", target, DOTTED)]
    curves = [*filtered, ("rendered", rendered, {"color": BLUE})]
    caption = TEXTS.line("contact_admittance", name=name, filtered=target is not None)
    return Plot(key, caption, lambda: draw_admittances(w, curves))


LEVELS = (-1000.0, -100.0, -10.0, -1.0, -0.1, 0.0, 0.1, 1.0, 10.0, 100.0, 1000.0)
"""Growth rates in 1/s between which a map of stability has one color."""


def tint(color: Any, share: float) -> tuple[float, ...]:
    """Return a color so far from white; opacity would make a group in a PDF, whose edges show."""
    from matplotlib.colors import to_rgb

    return tuple(1.0 - share * (1.0 - c) for c in to_rgb(color))


def fill_growth(ax: Axes, k: np.ndarray, b: np.ndarray, growth: np.ndarray, least: float = LEVELS[0]) -> None:
    """Fill a map of growth rates in 1/s over stiffness in N/m and damping in N·s/m, with its axes and a color bar."""
    from matplotlib import colormaps
    from matplotlib.colors import SymLogNorm

    levels = [level for level in LEVELS if level >= least]
    norm, colors = SymLogNorm(linthresh=0.1, vmin=LEVELS[0], vmax=LEVELS[-1]), colormaps["RdBu_r"]
    between = [tint(colors(float(norm(0.5 * (low + high)))), 0.55) for low, high in pairwise(levels)]
    filled = ax.contourf(k, b, np.clip(growth, 0.999 * least, 0.999 * LEVELS[-1]), levels=levels, colors=between)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlim(k[0], k[-1])
    ax.set_ylim(b[0], b[-1])
    set_powers(ax.xaxis, ax.get_xlim(), 9)
    set_powers(ax.yaxis, ax.get_ylim(), 6)
    ax.set_xlabel(with_unit("stiffness kₑ of the environment", "N/m"))
    ax.set_ylabel(with_unit("damping bₑ", "N.s/m"))
    figure: Any = ax.figure
    figure.colorbar(filled, ax=ax, label=with_unit("growth rate σ", "1/s"), ticks=levels, format=level_text)


def contact_map(key: str, name: str, k: np.ndarray, b: np.ndarray, growth: np.ndarray) -> Plot:
    """Draw growth rates in 1/s over stiffness in N/m and damping in N·s/m, with the limit as a line."""

    def draw() -> Figure:
        with style():
            figure = new_figure(2.9)
            ax = figure.subplots()
            fill_growth(ax, k, b, growth)
            if np.min(growth) < 0.0 < np.max(growth):
                ax.contour(k, b, np.clip(growth, -999.0, 999.0), levels=[0.0], colors=[DARK], linewidths=1.6)
        return figure

    return Plot(key, TEXTS.line("contact_map", name=name), draw)
