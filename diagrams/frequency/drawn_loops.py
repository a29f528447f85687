"""Loops as they are drawn: their names, the frequencies that are worth looking at, values, and margins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...blocks.core import LoopwrightError, OptionError, shorten
from ..plotting import COLORS, LINES
from .delayed_realization import DelayedRealization, realize
from .loop_margins import Margins, margins
from .loop_model import LoopModel

POINTS = 800
"""Frequencies at which a loop is drawn, without those at its resonances."""
BELOW = 1 - 1e-6
"""Part of π/T up to which a sampled loop is drawn."""
AROUND = 3.0
"""Factor by which what is drawn goes beyond the crossovers at which margins are read."""


@dataclass(frozen=True)
class DrawnLoop:
    """A loop to draw, L at rising frequencies, with the margins that are marked."""

    title: str
    omega: np.ndarray  # in rad/s
    values: np.ndarray
    look: Mapping[str, Any]
    margins: Margins | None = None  # None where they are not known
    dt: float = 0.0  # 0 of a continuous loop
    is_measured: bool = False  # whether the values are points of data

    @property
    def color(self) -> Any:
        """Color of the curve and of its marks."""
        return self.look["color"]

    def shows(self, omega: float) -> bool:
        """Whether a frequency is among those that are drawn."""
        return len(self.omega) > 0 and bool(self.omega[0] <= omega <= self.omega[-1])

    def gain_crossovers(self) -> list[tuple[float, float]]:
        """Return the frequencies in view at which |L| = 1, in rad/s, with the phase margins there in degrees."""
        found = () if self.margins is None else self.margins.gain_crossovers
        pairs = [(c.frequency.value, c.phase_margin_deg.value) for c in found]
        return [pair for pair in pairs if self.shows(pair[0])]

    def phase_crossovers(self) -> list[tuple[float, float]]:
        """Return the frequencies in view at which L is real and negative, in rad/s, with the gain margins there."""
        found = () if self.margins is None else self.margins.phase_crossovers
        pairs = [(c.frequency.value, c.gain_margin.value) for c in found]
        return [pair for pair in pairs if self.shows(pair[0]) and 0.0 < pair[1] < np.inf]


def phase_of(loop: DrawnLoop) -> np.ndarray:
    """Return the phase of a loop in degrees without jumps, on the branch on which its phase margin can be read.

    It is −180° plus the phase margin at the gain crossover with the smallest one. Without such a crossover it is −180°
    at the phase crossover whose gain margin is nearest to 1. Without both, it is in (−270°, 90°] at the lowest
    frequency.
    """
    phase = np.degrees(np.unwrap(np.angle(loop.values)))
    if crossings := loop.gain_crossovers():
        omega, margin = min(crossings, key=lambda pair: abs(pair[1]))
        wanted = margin - 180.0
    elif crossings := loop.phase_crossovers():
        omega, wanted = min(crossings, key=lambda pair: abs(np.log(pair[1])))[0], -180.0
    else:
        return np.asarray(phase - 360.0 * np.ceil((phase[:1] - 90.0) / 360.0))
    return np.asarray(phase + 360.0 * np.round((wanted - np.interp(omega, loop.omega, phase)) / 360.0))


def drawn_loops(
    loops: Sequence[Any], names: Sequence[str], omega: ArrayLike | None, *, marked: bool
) -> list[DrawnLoop]:
    """Return loops as they are drawn."""
    found = [confirmed_margins(loop) if marked else None for loop in loops]
    return [
        DrawnLoop(
            name,
            w,
            response_of(loop, w),
            style_of(i, loop),
            own,
            0.0 if is_measured(loop) else float(loop.dt or 0.0),
            is_measured(loop),
        )
        for i, (loop, name, own, w) in enumerate(zip(loops, names, found, find_spans(loops, found, omega), strict=True))
    ]


def name_loops(loops: Sequence[Any], labels: Sequence[str] | None) -> list[str]:
    """Return a label for each loop with one input and one output: its name, numbered where it repeats."""
    for loop in loops:
        size = getattr(loop, "noutputs", None), getattr(loop, "ninputs", None)
        if size != (1, 1):
            found = f"{size[0]} outputs and {size[1]} inputs" if size[0] else f"{type(loop).__name__}"
            raise OptionError(
                f"found {found}; expected a loop with one input and one output, as linearize().loop('u') or a "
                "python-control system. Plot an entry, L[0, 0], or look at mimo_disk_margin(L).",
                block=str(getattr(loop, "name", None) or "loop"),
            )
    if labels is None:
        names = [str(getattr(loop, "name", None) or "loop") for loop in loops]
        return [f"{n} ({names[: i + 1].count(n)})" if names.count(n) > 1 else n for i, n in enumerate(names)]
    if len(labels) != len(loops):
        raise OptionError(
            f"found {len(labels)} labels for {len(loops)} loops; expected one for each. Give as many.",
            port="labels",
        )
    return [str(label) for label in labels]


def is_measured(loop: Any) -> bool:
    """Whether a loop is frequency-response data rather than a linear system."""
    return hasattr(loop, "frdata") and hasattr(loop, "omega")


def limit_of(loop: Any) -> float:
    """Return half the sampling frequency of a loop in rad/s; infinite of a continuous one, and of data."""
    dt = 0.0 if is_measured(loop) else float(loop.dt or 0.0)
    return float(np.pi) / dt if dt else np.inf


def read_omega(omega: Any) -> np.ndarray:
    """Return frequencies that were given, in ascending order, each once."""
    return np.unique(np.asarray(omega, dtype=float))


def response_of(loop: Any, omega: np.ndarray) -> np.ndarray:
    """Return the values of a loop at frequencies in rad/s; of data those that it has."""
    if is_measured(loop):
        return np.asarray(np.reshape(loop.frdata, (1, 1, -1))[0, 0], dtype=complex)
    return np.asarray(realize(loop).response(omega)[0])


def confirmed_margins(loop: Any) -> Margins | None:
    """Return the margins of a loop; None of data, and where they can't be confirmed."""
    if is_measured(loop):
        return None
    try:
        return margins(loop)
    except LoopwrightError:  # a figure is drawn all the same: margins(loop) says why
        return None


def style_of(i: int, loop: Any) -> dict[str, Any]:
    """Return the color and the line of the i-th loop; data are points."""
    color = COLORS[i % len(COLORS)]
    if is_measured(loop):
        return {"color": color, "linestyle": "none", "marker": "o", "markersize": 3.5, "fillstyle": "none"}
    return {"color": color, "linestyle": LINES[(i // len(COLORS) + i) % len(LINES)]}


def frequencies_of(loop: Any) -> np.ndarray:
    """Return frequencies in rad/s over which a loop is worth looking at: around its crossovers, poles and zeros."""
    if is_measured(loop):
        return np.asarray(loop.omega, dtype=float)
    r = realize(loop)
    if isinstance(r, DelayedRealization):
        return _between_crossings(r, r.features.sizes())
    dt = float(loop.dt or 0.0)
    marks = np.abs(np.concatenate([np.ravel(loop.poles()), np.ravel(loop.zeros())]))
    if dt:
        roots = np.concatenate([np.ravel(loop.poles()), np.ravel(loop.zeros())]).astype(complex)
        with np.errstate(all="ignore"):
            marks = np.abs(np.log(roots[np.abs(roots) > 1e-6]) / dt)
    return _between_crossings(r, marks)


def _between_crossings(r: LoopModel, marks: np.ndarray) -> np.ndarray:
    """Return frequencies around the crossovers of a loop, whose poles and zeros have these sizes in rad/s."""
    limit = r.nyquist
    marks = marks[np.isfinite(marks) & (marks > 1e-6) & (marks < limit)]
    high = min(1e3 * float(np.max(marks, initial=1.0)), limit)
    wide = np.geomspace(1e-3 * float(np.min(marks, initial=min(1.0, 0.1 * limit))), high, 2000)
    size = np.abs(r.response(wide * (1 - 1e-9))[0])
    crossed = wide[1:][(size[1:] > 1.0) != (size[:-1] > 1.0)]
    if crossed.size:
        low, high = float(crossed[0]) / 50, min(float(crossed[-1]) * 50, limit)
    else:
        low, high = wide[0] * 100, min(high / 30, limit)
    return np.geomspace(min(low, high / 100), high * (1 - 1e-9 if r.dt else 1.0), POINTS)


def find_spans(loops: Sequence[Any], found: Sequence[Margins | None], omega: ArrayLike | None) -> list[np.ndarray]:
    """Return the frequencies of each loop: those that are asked for, below half its sampling frequency.

    Without any, all loops are drawn over the same ones: around their crossovers, and up to half the sampling frequency
    of the fastest loop. The crossovers at which their margins are read are well within.
    """
    own = [frequencies_of(loop) for loop in loops]
    read = [w for one in found if one is not None for w in one.deciding_frequencies()]
    low = min([*(float(w[0]) for w in own), *(w / AROUND for w in read)])
    high = max([*(float(w[-1]) for w in own), *(w * AROUND for w in read)])
    ends = [end for end in map(limit_of, loops) if np.isfinite(end)]
    high = max([high, *ends]) if omega is None else high
    spans = []
    for loop, w in zip(loops, own, strict=True):
        if is_measured(loop):
            spans.append(w)
            continue
        if omega is None:
            spans.append(realize(loop).grid(low, min(high, BELOW * limit_of(loop)), POINTS))
            continue
        asked = read_omega(omega)
        limit = limit_of(loop)
        shown = asked[asked < limit]
        if not shown.size:
            raise OptionError(
                f"found {shorten(omega)} rad/s, none below π/T = {limit:.6g} rad/s of the loop sampled every "
                f"{float(loop.dt):g} s; expected one at least. Give lower ones, or leave the loop out.",
                port="omega",
            )
        spans.append(
            np.append(shown, limit * BELOW) if shown.size < asked.size and shown[-1] < limit * BELOW else shown
        )
    return spans
