"""Figures of contacts: admittances, and growth rates over properties of the environment."""

from __future__ import annotations

import numpy as np

from ...blocks.core import with_unit
from ..report_writing import Plot, Texts
from ..results import BLUE, DARK, VERMILION, legend_above, new_figure, style

TEXTS = Texts(__package__, "figures")


def level_text(value: float, position: int | None = None) -> str:
    """Return a level of a color bar in plain characters, with a minus that is one."""
    return f"{value:g}".replace("-", "−")


def contact_admittance(
    key: str, name: str, w: np.ndarray, rendered: np.ndarray, target: np.ndarray | None = None
) -> Plot:
    """Draw the admittance of a contact over ω in rad/s, and that of its filter: magnitude and phase."""
    with style():
        figure = new_figure(3.2)
        top, bottom = figure.subplots(2, 1, sharex=True)
        if target is not None:
            look = {"color": DARK, "linestyle": (0, (1, 1.5)), "linewidth": 1.6}
            top.loglog(w, np.abs(target), label="filter", **look)
            bottom.semilogx(w, np.degrees(np.angle(target)), **look)
        top.loglog(w, np.abs(rendered), label="rendered", color=BLUE)
        bottom.semilogx(w, np.degrees(np.angle(rendered)), color=BLUE)
        for y in (-90, 90):
            bottom.axhline(y, color=DARK, linewidth=0.6)
        for low in (90, -180):
            bottom.axhspan(low, low + 90, color=VERMILION, alpha=0.07, linewidth=0)
        bottom.set_ylim(-180, 180)
        bottom.set_yticks([-180, -90, 0, 90, 180])
        top.set_ylabel(with_unit("|Y|", "m/(N.s)"))
        bottom.set_ylabel(with_unit("phase of Y", "deg"))
        bottom.set_xlabel(with_unit("ω", "rad/s"))
        legend_above(figure, top)
    return Plot(key, TEXTS.line("contact_admittance", name=name, filtered=target is not None), figure)


def contact_map(key: str, name: str, k: np.ndarray, b: np.ndarray, growth: np.ndarray) -> Plot:
    """Draw growth rates in 1/s over stiffness in N/m and damping in N·s/m, with the limit as a line."""
    from matplotlib.colors import SymLogNorm

    levels = [-1000, -100, -10, -1, -0.1, 0, 0.1, 1, 10, 100, 1000]
    with style():
        figure = new_figure(2.9)
        ax = figure.subplots()
        shown = np.clip(growth, -999.0, 999.0)
        norm = SymLogNorm(linthresh=0.1, vmin=-1000, vmax=1000)
        filled = ax.contourf(k, b, shown, levels=levels, cmap="RdBu_r", alpha=0.55, norm=norm)
        if np.min(shown) < 0.0 < np.max(shown):
            ax.contour(k, b, shown, levels=[0.0], colors=[DARK], linewidths=1.6)
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.set_xlabel(with_unit("stiffness kₑ of the environment", "N/m"))
        ax.set_ylabel(with_unit("damping bₑ", "N.s/m"))
        figure.colorbar(filled, ax=ax, label=with_unit("growth rate σ", "1/s"), ticks=levels, format=level_text)
    return Plot(key, TEXTS.line("contact_map", name=name), figure)
