"""Poles in the plane: root loci, and maps of poles and zeros, with lines of equal damping and natural frequency.

The locus is made of eigenvalues, not of polynomials as python-control's is: coefficients of a sampled loop of ten
states, whose poles lie near 1, have lost most of their digits.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ...blocks.core import OptionError, decibels, with_unit
from ..plotting import BLUE, COLORS, DARK, GREEN, GREY, STONE, VERMILION, legend_above, shown_figure
from .poles_and_zeros import finite_zeros

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from .loop_margins import Margins

DAMPING = (0.2, 0.4, 0.6, 0.8)
"""Damping ratios whose lines are drawn."""
GAINS = (1e-3, 1e3)
"""Range of the gain by default, next to 0."""
MOST = 2000
"""Gains at most, where the branches move fast."""
CLOSEST = 1e-7
"""Smallest distance of two gains, relative to them: where branches meet, they move as its square root."""
STEP = 0.012
"""Largest step of a branch in view, relative to the view."""


class Locus(NamedTuple):
    """Closed-loop poles over the gain: gains (K,), and the branches (K, n)."""

    gains: np.ndarray
    branches: np.ndarray


class View(NamedTuple):
    """The part of the plane that is shown."""

    left: float
    right: float
    top: float

    @property
    def size(self) -> float:
        """The larger of width and height."""
        return max(self.right - self.left, 2.0 * self.top)


def closed_loop_poles(loop: Any, gain: float) -> np.ndarray:
    """Return the poles of the loop k L closed by −1, for a gain k."""
    A, B, C, d = loop.A, loop.B, loop.C, float(loop.D[0, 0])
    if abs(1.0 + gain * d) < 1e-12 * (1.0 + abs(gain * d)):  # at this gain a pole is at infinity
        return np.full(len(A), np.nan, dtype=complex)
    return np.asarray(np.linalg.eigvals(A - B @ C * (gain / (1.0 + gain * d))), dtype=complex)


def find_locus(loop: Any, gains: np.ndarray | None, view: View, marked: Sequence[float] = ()) -> Locus:
    """Return the poles over gains, each branch in its column; gains that are not given lie dense where poles move."""
    low, high = min([GAINS[0], *(0.5 * k for k in marked)]), max([GAINS[1], *(2.0 * k for k in marked)])
    first = (0.0, *np.geomspace(low, high, 121), 1.0, *marked) if gains is None else map(float, gains)
    found = {k: closed_loop_poles(loop, k) for k in first}
    wide = sorted(found)[:-1] if gains is None else []
    while wide and len(found) < MOST:
        after = dict(pairwise(sorted(found)))
        halved = []
        for low in wide:
            high = after[low]
            if high - low > CLOSEST * high and _moves(found[low], found[high], view) > STEP * view.size:
                middle = 0.5 * (low + high)
                found[middle] = closed_loop_poles(loop, middle)
                halved += [low, middle]
        wide = halved
    ordered = sorted(found)
    rows = [found[ordered[0]]]
    for k in ordered[1:]:
        rows.append(_matched(rows[-1], found[k]))
    return Locus(np.array(ordered), np.array(rows))


def _moves(row: np.ndarray, following: np.ndarray, view: View) -> float:
    """Return the longest way of a pole in view from one gain to the next."""
    following = _matched(row, following)
    way = np.nan_to_num(np.abs(following - row))
    return float(np.max(np.where(_is_in(row, view) | _is_in(following, view), way, 0.0), initial=0.0))


def _matched(row: np.ndarray, following: np.ndarray) -> np.ndarray:
    """Return the poles at the next gain in the order in which they move least."""
    if not (np.all(np.isfinite(row)) and np.all(np.isfinite(following))):
        return following
    from scipy.optimize import linear_sum_assignment

    return np.asarray(following[linear_sum_assignment(np.abs(row[:, None] - following[None, :]))[1]])


def _is_in(points: np.ndarray, view: View) -> np.ndarray:
    pad = 0.1 * view.size
    inside = (points.real > view.left - pad) & (points.real < view.right + pad)
    return np.asarray(inside & (np.abs(points.imag) < view.top + pad))


def plot_root_locus(loop: Any, name: str, gains: np.ndarray | None, margins: Margins | None) -> Figure:
    """Return the locus of the closed-loop poles; see `LoopPlots.root_locus`."""
    dt = float(loop.dt or 0.0)
    poles, zeros, now = np.ravel(loop.poles()), finite_zeros(loop), closed_loop_poles(loop, 1.0)
    crossing = [] if margins is None else [c.frequency.value for c in margins.gain_crossovers]
    limits = _limits(margins, dt)
    view = _view([poles, zeros, now, np.array([pole for _, pole in limits])], dt, max(crossing, default=0.0))
    shown = [(factor, pole) for factor, pole in limits if _is_in(np.array([pole]), view)]
    read = () if margins is None else (margins.gain_margin_low.value, margins.gain_margin_high.value)
    locus = find_locus(loop, gains, view, [factor for factor, _ in shown])
    with shown_figure(*_size(view)) as figure:
        axes = figure.subplots()
        _draw_plane(axes, view, dt)
        for i, branch in enumerate(locus.branches.T):
            label = "closed-loop poles of k L" if i == 0 else None
            axes.plot(branch.real, branch.imag, color=COLORS[0], label=label, marker="." if len(branch) == 1 else "")
        _draw_points(axes, poles, zeros, color=DARK)
        square: dict[str, Any] = {"marker": "s", "color": VERMILION, "linestyle": "none", "markersize": 4.5}
        axes.plot(now.real, now.imag, label="k = 1", zorder=4, **square)
        if shown:
            ends = np.array([pole for _, pole in shown])
            diamond: dict[str, Any] = {"marker": "d", "color": GREEN, "markersize": 5.0, "linestyle": "none"}
            axes.plot(ends.real, ends.imag, label="limit of stability", zorder=4, **diamond)
        for factor, pole in shown:
            if factor in read:
                _name_limit(axes, factor, pole, view)
        axes.set_title(f"root locus of {name}", loc="right", fontsize="small")
        legend_above(figure, axes)
    return figure


def _name_limit(axes: Axes, factor: float, pole: complex, view: View) -> None:
    """Write the gain next to a limit of stability, on the side that has more room."""
    white = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}
    look: dict[str, Any] = {"textcoords": "offset points", "fontsize": 7, "color": DARK, "bbox": white}
    is_left = pole.real < 0.5 * (view.left + view.right)
    look |= {"ha": "left" if is_left else "right", "zorder": 3.5}
    axes.annotate(f"k = {factor:.4g} ({decibels(factor)})", (pole.real, pole.imag), (7 if is_left else -7, 4), **look)


def _limits(margins: Margins | None, dt: float) -> list[tuple[float, complex]]:
    """Return the gains at which poles are on the limit of stability, and these poles in the upper half plane."""
    found = [] if margins is None else [(p.gain_margin.value, p.frequency.value) for p in margins.phase_crossovers]
    return [
        (k, complex(np.exp(1j * omega * dt)) if dt else 1j * omega)
        for k, omega in found
        if 0.0 < k < np.inf and np.isfinite(omega)
    ]


def plot_poles(poles: np.ndarray, zeros: np.ndarray | None, dt: float, title: str, *, are_all: bool = True) -> Figure:
    """Return a map of poles and zeros; see `Linearization.pzmap`."""
    crosses, circles = np.ravel(poles), np.ravel(np.zeros(0) if zeros is None else zeros)
    view = _view([crosses, circles], dt, 0.0)
    with shown_figure(*_size(view)) as figure:
        axes = figure.subplots()
        _draw_plane(axes, view, dt)
        _draw_points(axes, crosses, circles, color=BLUE)
        axes.set_title(
            title + ("" if are_all else ": the rightmost ones of infinitely many"), loc="right", fontsize="small"
        )
        legend_above(figure, axes)
    return figure


def _draw_points(axes: Axes, poles: np.ndarray, zeros: np.ndarray, color: str) -> None:
    look: dict[str, Any] = {"color": color, "linestyle": "none", "markersize": 6.0, "zorder": 3}
    axes.plot(poles.real, poles.imag, marker="x", label="poles", **look)
    if len(zeros):
        axes.plot(zeros.real, zeros.imag, marker="o", fillstyle="none", label="zeros", **look)


def _view(points: list[np.ndarray], dt: float, crossover: float) -> View:
    """Return the part of the plane that holds the points, but for those far beyond a loop's crossover in rad/s."""
    every = np.concatenate([np.ravel(p) for p in points]).astype(complex)
    every = every[np.isfinite(every)]
    if dt:  # the unit circle, and what is not far from it
        near = every[np.abs(every) < 2.5]
        low, high = min(-1.0, float(near.real.min(initial=-1.0))), max(1.0, float(near.real.max(initial=1.0)))
        return View(low - 0.15, high + 0.15, max(1.0, float(np.abs(near.imag).max(initial=1.0))) + 0.15)
    near = every[np.abs(every) <= 10.0 * crossover] if crossover else every
    size = float(np.abs(near).max(initial=crossover)) or 1.0
    low, high = float(near.real.min(initial=-0.3 * size)), float(near.real.max(initial=0.1 * size))
    top = max(float(np.abs(near.imag).max(initial=0.0)), crossover, 0.3 * size)
    left, right = low - 0.25 * size, high + 0.15 * size
    return View(left, right, max(1.2 * top, 0.3 * (right - left)))


def _size(view: View) -> tuple[float, float]:
    """Return the height of a figure of the usual width, in which both axes have the same scale, and that width."""
    from ..plotting import WIDTH

    ratio = 2.0 * view.top / (view.right - view.left)
    return float(np.clip(0.8 + (WIDTH - 0.9) * ratio, 3.2, 6.2)), WIDTH


def _draw_plane(axes: Axes, view: View, dt: float) -> None:
    """Draw the axes, the limit of stability, and lines of equal damping and natural frequency."""
    axes.grid(visible=False)
    thin: dict[str, Any] = {"color": GREY, "linewidth": 0.4, "zorder": 0}
    axes.axhline(0.0, color=GREY, linewidth=0.8, zorder=0)
    if dt:
        _draw_unit_circle(axes, thin)
        axes.set(xlabel="Re z", ylabel="Im z")
    else:
        axes.axvline(0.0, color=DARK, linewidth=0.8, zorder=0)
        reach = 2.0 * view.size
        for damping in DAMPING:
            end = reach * complex(-damping, np.sqrt(1.0 - damping**2))
            for sign in (1.0, -1.0):
                axes.plot([0.0, end.real], [0.0, sign * end.imag], **thin)
            edge = min(-view.left / damping, view.top / np.sqrt(1.0 - damping**2)) * 0.94
            at = edge * complex(-damping, np.sqrt(1.0 - damping**2))
            axes.text(at.real, at.imag, f"{damping:g}", fontsize=6, color=STONE, ha="center", clip_on=True)
        angle = np.linspace(0.5 * np.pi, 1.5 * np.pi, 121)
        for radius in _rounds(view):
            axes.plot(radius * np.cos(angle), radius * np.sin(angle), **thin)
            axes.text(-radius, 0.0, f"{radius:g}", fontsize=6, color=STONE, va="bottom", clip_on=True)
        axes.set(xlabel=with_unit("Re s", "rad/s"), ylabel=with_unit("Im s", "rad/s"))
    axes.set_aspect("equal", adjustable="box")
    axes.set(xlim=(view.left, view.right), ylim=(-view.top, view.top))


def _draw_unit_circle(axes: Axes, thin: dict[str, Any]) -> None:
    """Draw the unit circle, and within it lines of equal damping, and of equal natural frequency in parts of π/T."""
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    axes.plot(np.cos(angle), np.sin(angle), color=DARK, linewidth=0.8, zorder=0)
    for damping in DAMPING:
        turn = np.linspace(0.0, np.pi / np.sqrt(1.0 - damping**2), 121)
        line = np.exp(turn * complex(-damping, np.sqrt(1.0 - damping**2)))
        line = np.where(np.angle(line) >= -1e-9, line, np.nan)
        axes.plot(line.real, line.imag, **thin)
        axes.plot(line.real, -line.imag, **thin)
    for part in range(1, 11):
        sector = np.linspace(0.5 * np.pi, np.pi, 61)
        line = np.exp(0.1 * part * np.pi * np.exp(1j * sector))
        axes.plot(line.real, line.imag, **thin)
        axes.plot(line.real, -line.imag, **thin)
        end = np.exp(0.1j * part * np.pi)
        text = "π/T" if part == 10 else f"{0.1 * part:.1g} π/T"
        look: dict[str, Any] = {"fontsize": 6, "color": STONE, "va": "center", "clip_on": True}
        axes.text(1.06 * end.real, 1.06 * end.imag, text, ha="left" if end.real > -0.5 else "right", **look)


def _rounds(view: View) -> list[float]:
    """Return natural frequencies in rad/s whose circles are drawn: a few round ones."""
    from matplotlib.ticker import MaxNLocator

    reach = max(-view.left, view.top)
    return [float(r) for r in MaxNLocator(5).tick_values(0.0, reach) if 0.0 < r <= 1.5 * reach]


def refuse_delays(loop: Any, name: str) -> None:
    """Refuse the locus of a loop with delays, which has infinitely many branches."""
    if hasattr(loop, "delays"):
        raise OptionError(
            "found a loop with delays, whose poles are infinitely many; expected one without. Take a rational "
            "model, linearize(delays='pade'), or look at L.nyquist() and margins(L).",
            block=name,
        )
