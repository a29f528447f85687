"""Drawing of loops into axes: Bode, Nyquist and Nichols, with the margins marked; for people and for reports."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import decibels, with_unit
from ..plotting import DARK, GREY, STONE, AxisUnits, set_degrees, set_frequencies, set_magnitudes
from .drawn_loops import DrawnLoop, phase_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from .loop_margins import Margins

OFF_THE_PAGE = 1e3
"""Size of L from which on it is not drawn in the complex plane: beyond lies the other branch of a resonance."""


def _reference(loop: DrawnLoop, phase: np.ndarray, omega: float, margin: float = 0.0) -> float:
    """Return −180°, or that and whole turns: the phase of −1 from which a margin is read at a frequency."""
    return 360.0 * round((float(np.interp(omega, loop.omega, phase)) - margin + 180.0) / 360.0) - 180.0


def draw_bode_axes(top: Axes, bottom: Axes, loops: Sequence[DrawnLoop], units: AxisUnits, *, few: bool = False) -> None:
    """Draw gain and phase over frequency, with few ticks in a small figure.

    Thick lines are the phase margin at each |L| = 1 (○), and the gain margin at each crossing of −180° (□).
    """
    references = {-180.0}
    for loop in loops:
        phase = phase_of(loop)
        top.semilogx(units.frequency(loop.omega), units.magnitude(np.abs(loop.values)), label=loop.title, **loop.look)
        bottom.semilogx(units.frequency(loop.omega), phase, label=loop.title, **loop.look)
        mark: dict[str, Any] = {"color": loop.color, "linestyle": "none", "markersize": 3.5}
        line: dict[str, Any] = {"color": loop.color, "linewidth": 2.0, "alpha": 0.6}
        for omega, margin in loop.gain_crossovers():
            x, reference = units.frequency(omega), _reference(loop, phase, omega, margin)
            references.add(reference)
            top.plot(x, units.magnitude(1.0), marker="o", **mark)
            bottom.plot([x, x], [reference, reference + margin], **line)
        for omega, factor in loop.phase_crossovers():
            x, reference = units.frequency(omega), _reference(loop, phase, omega)
            references.add(reference)
            top.plot([x] * 2, units.magnitude([1.0, 1.0 / factor]), **line)
            bottom.plot(x, reference, marker="s", **mark)
        if loop.dt:
            for ax in (top, bottom):
                ax.axvline(float(units.frequency(np.pi / loop.dt)), color=GREY, linewidth=0.6, linestyle=":")
    set_magnitudes(top, units, 5 if few else 6)
    top.axhline(float(units.magnitude(1.0)), color=DARK, linewidth=0.6)
    low, high = bottom.get_ylim()
    for reference in references:
        if reference == -180.0 or low < reference < high:
            bottom.axhline(reference, color=DARK, linewidth=0.6)
    set_degrees(bottom, few=few)
    set_frequencies(bottom, 5 if few else 9)
    top.set_ylabel(units.magnitude_label("|L|"))
    bottom.set_ylabel(with_unit("phase" if few else "phase of L", "deg"))
    bottom.set_xlabel(units.frequency_label)


def draw_nyquist_axes(ax: Axes, loops: Sequence[DrawnLoop]) -> None:
    """Draw L in the complex plane; the limits of the axes are the caller's.

    Negative frequencies are thin. Marked are −1, the points with |L| = 1 (○), whose angle from −1 is the phase margin,
    the crossings of the negative real axis (□), and the largest circle around −1 that L keeps out of (dotted).
    """
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    ax.plot(np.cos(angle), np.sin(angle), color=GREY, linewidth=0.6)
    for loop in loops:
        factors = [] if loop.margins is None else [p.gain_margin.value for p in loop.margins.phase_crossovers]
        far = max([OFF_THE_PAGE, *(abs(10.0 / k) for k in factors if k)])
        value = np.where(np.abs(loop.values) < far, loop.values, np.nan)
        ax.plot(value.real, value.imag, label=loop.title, **loop.look)
        if loop.is_measured:
            continue
        line = {"color": loop.color, "linewidth": 0.5}
        ax.plot(value.real, -value.imag, **line, linestyle=loop.look["linestyle"])
        _draw_arrows(ax, value, loop.color)
        if loop.margins is None:
            continue
        radius = loop.margins.modulus_margin.value
        if np.isfinite(radius):
            ax.plot(-1.0 + radius * np.cos(angle), radius * np.sin(angle), **line, linestyle=":")
        for crossover in loop.margins.gain_crossovers:
            end = np.exp(1j * np.radians(crossover.phase_margin_deg.value - 180.0))
            ax.plot([0.0, end.real], [0.0, end.imag], color=loop.color, linewidth=0.6)
            ax.plot(end.real, end.imag, "o", color=loop.color, markersize=3.5)
        for factor in factors:
            if factor:
                ax.plot(-1.0 / factor, 0.0, "s", color=loop.color, markersize=3.0)
    ax.plot(-1.0, 0.0, "+", color=DARK, markersize=9, markeredgewidth=1.4)
    ax.set_aspect("equal")
    ax.set_xlabel("Re L")
    ax.set_ylabel("Im L")


def _draw_arrows(ax: Axes, value: np.ndarray, color: Any) -> None:
    """Draw arrowheads in the direction of rising frequency, at sizes of L that are in view."""
    for size in (0.7, 1.5, 6.0):
        far = np.abs(np.log(np.maximum(np.abs(value), 1e-300) / size))
        k = int(np.argmin(np.where(np.isnan(far), np.inf, far)))
        if 0 < k < len(value) - 1 and far[k] < 0.2 and np.isfinite(value[k + 1]):
            ends = [(float(z.real), float(z.imag)) for z in value[[k, k + 1]]]
            arrow = {"arrowstyle": "-|>", "color": color, "linewidth": 0.8}
            ax.annotate("", xy=ends[1], xytext=ends[0], arrowprops=arrow, annotation_clip=True)


def draw_nichols_axes(ax: Axes, loops: Sequence[DrawnLoop]) -> None:
    """Draw gain over phase with contours of |T| in dB; thick lines are phase margins (○) and gain margins (□)."""
    for loop in loops:
        phase = phase_of(loop)
        ax.plot(phase, 20.0 * np.log10(np.abs(loop.values)), label=loop.title, **loop.look)
        mark: dict[str, Any] = {"color": loop.color, "linestyle": "none", "markersize": 3.5}
        line: dict[str, Any] = {"color": loop.color, "linewidth": 2.0, "alpha": 0.6}
        for omega, margin in loop.gain_crossovers():
            reference = _reference(loop, phase, omega, margin)
            ax.plot([reference, reference + margin], [0.0, 0.0], **line)
            ax.plot(reference + margin, 0.0, marker="o", **mark)
        for omega, factor in loop.phase_crossovers():
            at = _reference(loop, phase, omega)
            ax.plot([at, at], [0.0, -20.0 * np.log10(factor)], **line)
            ax.plot(at, -20.0 * np.log10(factor), marker="s", **mark)
    left, right = ax.get_xlim()
    left, right = min(left, -225.0), max(right, -90.0)
    low, high = max(ax.get_ylim()[0], -40.0), min(ax.get_ylim()[1], 40.0)
    low, high = min(low, -20.0), max(high, 20.0)
    phases, gains = np.meshgrid(np.linspace(left, right, 400), np.linspace(low, high, 300))
    value = 10.0 ** (gains / 20.0) * np.exp(1j * np.radians(phases))
    with np.errstate(divide="ignore"):
        closed = 20.0 * np.log10(np.abs(value / (1.0 + value)))
    lines = ax.contour(phases, gains, closed, levels=[-12, -6, -3, 0, 3, 6, 12], colors=STONE, linewidths=0.5)
    ax.clabel(lines, fmt=lambda value: f"{value:g} dB".replace("-", "−"), fontsize=6)
    points = [360.0 * n - 180.0 for n in range(-20, 20) if left <= 360.0 * n - 180.0 <= right]
    ax.plot(points, [0.0] * len(points), marker="+", color=DARK, markersize=9, linestyle="none")
    ax.set(xlim=(left, right), ylim=(low, high), xlabel=with_unit("phase of L", "deg"), ylabel=with_unit("|L|", "dB"))


def describe_margins(margins: Margins | None) -> str:
    """Return the gain and phase margin in a line, "" where they are not known."""
    if margins is None:
        return ""
    if not margins.stable:
        return "the closed loop is unstable"
    low, high, phase = (
        getattr(margins, name).value for name in ("gain_margin_low", "gain_margin_high", "phase_margin_deg")
    )
    factors = [k for k in (low, high) if 0.0 < k < np.inf]
    gains = "gain margin " + (" and ".join(f"{k:.4g} ({decibels(k)})" for k in factors) if factors else "∞")
    return f"{gains}, phase margin {phase:.4g}°" if np.isfinite(phase) else gains
