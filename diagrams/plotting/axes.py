"""Axes of figures: their units, and ticks that don't overlap."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ...blocks.core import with_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

ZERO = "0 at all frequencies"
"""Words in a figure for a curve that a logarithmic axis can't show."""
FINEST = 5
"""Smallest step in degrees between the ticks of a phase."""
DECADES = 2.0
"""Decades from which on the ticks of a logarithmic axis are powers of ten."""


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


class AxisUnits(NamedTuple):
    """Units of the axes of frequency responses: plain or in dB, over rad/s or Hz."""

    decibels: bool = False
    hertz: bool = False

    def magnitude(self, value: Any) -> np.ndarray:
        """Return magnitudes in the unit of their axis."""
        data = np.asarray(value, dtype=float)
        with np.errstate(divide="ignore"):
            return np.asarray(20 * np.log10(data)) if self.decibels else data

    def frequency(self, omega: Any) -> np.ndarray:
        """Return frequencies, which are in rad/s, in the unit of their axis."""
        return np.asarray(omega, dtype=float) / (2 * np.pi if self.hertz else 1.0)

    @property
    def frequency_label(self) -> str:
        """Label of the frequency axis."""
        return with_unit("frequency", "Hz") if self.hertz else with_unit("ω", "rad/s")

    def magnitude_label(self, name: str) -> str:
        """Return the label of a magnitude's axis."""
        return with_unit(name, "dB" if self.decibels else "1")


def set_magnitudes(ax: Axes, axes: AxisUnits, most: int = 6) -> None:
    """Set the scale of a magnitude's axis, with few ticks; a curve that is 0 at all frequencies is named."""
    from matplotlib.ticker import MaxNLocator

    mark_zeros(ax)
    if axes.decibels:
        ax.yaxis.set_major_locator(MaxNLocator(most, steps=[1, 2, 4, 5, 10]))
    else:
        ax.set_yscale("log")
        set_powers(ax.yaxis, ax.get_ylim(), most)


def mark_zeros(ax: Axes) -> None:
    """Take curves that are 0 everywhere, which a logarithmic axis can't show, off an axis, and say so in the figure."""
    curves = [(line, np.asarray(line.get_ydata(), dtype=float)) for line in ax.lines]
    curves = [(line, y) for line, y in curves if len(y) > 1]
    zero = [line for line, y in curves if np.all((y == 0.0) | np.isneginf(y))]
    if not zero:
        return
    for line in zero:
        line.set_ydata(np.full(np.size(line.get_ydata()), np.nan))
    ax.relim()
    names = [str(line.get_label()) for line in zero]
    said = [f"{name}: {ZERO}" for name in names if not name.startswith("_")]
    text = ZERO if len(zero) == len(curves) or not said else "\n".join(said)
    ax.text(0.5, 0.5, text, transform=ax.transAxes, ha="center", va="center", fontsize="small")


def set_powers(axis: Axis, ends: tuple[float, float], most: int) -> None:
    """Set ticks of a logarithmic axis: powers of ten, and over few decades 1, 2 and 5 times them, as plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

    axis.set_minor_formatter(NullFormatter())
    decades = abs(math.log10(ends[1] / ends[0])) if min(ends) > 0 else DECADES
    if decades >= DECADES:
        axis.set_major_formatter(FuncFormatter(_power))
        axis.set_major_locator(LogLocator(numticks=most))
        if getattr(axis, "axis_name", "") == "y":  # they would touch, and cost a quarter of a figure's time
            axis.set_minor_locator(NullLocator())
        return
    axis.set_major_formatter(FuncFormatter(_label))
    subs = (1.0, 2.0, 5.0) if decades > 0.5 else (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)
    axis.set_major_locator(LogLocator(subs=subs, numticks=10 * most))


def _power(value: float, position: int | None = None) -> str:
    """Return a power of ten in plain characters: parsing mathematics takes more time than drawing all else."""
    return "10" + str(round(math.log10(value))).translate(_RAISED) if value > 0 else ""


def _label(value: float, position: int | None = None) -> str:
    """Return a number in plain characters, a large or a small one by its power of ten."""
    if not value > 0 or 1e-3 < value < 1e4:
        return f"{value:.6g}".replace("-", "−")
    power = math.floor(math.log10(value) + 1e-9)
    factor = value / 10.0**power
    return ("" if abs(factor - 1) < 1e-6 else f"{factor:.6g}·") + "10" + str(power).translate(_RAISED)


def set_degrees(ax: Axes, *, few: bool) -> None:
    """Set ticks of a phase at multiples of 45° or 90°; at few of them in a small figure."""
    from matplotlib.ticker import MultipleLocator

    low, high = ax.get_ylim()
    steps = {200: 90, 600: 180} if few else {300: 45, 600: 90, 1400: 180}
    step = next((step for span, step in steps.items() if high - low < span), 360)
    while step > FINEST and np.floor(high / step) - np.ceil(low / step) < 1:  # a scale has two labels
        step = next(finer for finer in (90, 45, 15, FINEST) if finer < step)
    ax.yaxis.set_major_locator(MultipleLocator(step, 180 if step == 360 else 0))  # −180° has a tick


def set_frequencies(ax: Axes, most: int = 5) -> None:
    """Set so many ticks at most on the frequency axis, so that none overlap: few on that of a narrow figure."""
    set_powers(ax.xaxis, ax.get_xlim(), most)
