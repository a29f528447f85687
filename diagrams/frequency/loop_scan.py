"""Frequency response of a loop with one channel, scanned: its crossings and peaks, refined as roots.

One with delays has crossings without end. The scan has those down to a size of |L|, below which none decides a margin.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from .poles_and_zeros import SIDES
from .scan_refine_confirm import refine_sign_change

if TYPE_CHECKING:
    from .loop_model import LoopModel

Function = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""From L and dL/d(log ω) to a value and its slope over log ω."""
PER_DECADE = 40
"""Frequencies of a scan, without those around poles and zeros."""
TURNS_MATTER = 0.3
"""|L| below which the turns that a delay makes don't matter for the encirclements of −1."""
HALVINGS = 24
"""Halvings of the steps of a scan next to roots at which |L| may be too small to be looked for."""
MANY = 100
"""Roots between samples above which those that can't have the largest |L| below 1 are left out."""
NARROWINGS = 12
"""Halvings of the steps in which they lie."""
POLISHED = 20
"""Number of candidates of a peak that are refined."""
FLOORS = (0.3, 0.1, 0.03, 0.01, 1e-3, 1e-4, 1e-6, 1e-9)
"""|L| above which all turns that delays make are resolved; tried until a phase crossover lies between it and 1."""


@dataclass(frozen=True)
class Crossing:
    """A frequency in rad/s at which a loop crosses the unit circle or the negative real axis."""

    omega: float
    L: complex
    slope: float
    """Slope over log ω of the function whose root the frequency is; zero at the ends of the axis."""
    error: float
    """Relative rounding error of L."""

    @property
    def tolerance(self) -> float:
        """Bound of the relative error of the frequency, and of L along the curve."""
        return max(1e-12, self.error * (1 + 3 / abs(self.slope)) if self.slope else 3 * self.error)


@dataclass(frozen=True)
class Peak:
    """The largest value of a function of frequency, and its frequency in rad/s."""

    value: float
    omega: float


@dataclass(frozen=True)
class _Search:
    """Roots of a function along a response that are looked for: those with |L| between two sizes, where L is wanted."""

    function: Function
    least: float = 0.0
    most: float = np.inf
    wanted: Callable[[np.ndarray], np.ndarray] | None = None

    def show(self, omega: np.ndarray, L: np.ndarray, dL: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the function's values at samples, and between which of them it may have a root that is looked for.

        It changes its sign there, or turns and may reach 0. Its slopes bound how far it goes: one that grows evenly
        takes it by half of the step times the larger slope; four times that is allowed. Where the function is constant
        but for rounding, its slope has any sign at every sample, and no turn is searched.
        """
        with np.errstate(all="ignore"):
            h, slope = self.function(L, dL)
            left, right = h[:-1], h[1:]
            reach = 2.0 * np.log(omega[1:] / omega[:-1]) * np.maximum(np.abs(slope[:-1]), np.abs(slope[1:]))
            turns = (left * slope[:-1] < 0) & (right * slope[1:] > 0)
            turns &= np.minimum(np.abs(left), np.abs(right)) <= reach
            shown = (~(left * right > 0) | turns) & np.isfinite(left) & np.isfinite(right)
        if self.wanted is not None:
            wanted = self.wanted(L)
            shown &= wanted[:-1] | wanted[1:]
        if self.least or np.isfinite(self.most):
            low, high = self._bound(omega, L, dL)
            shown &= ~((high < self.least) | (low > self.most))
        return h, np.asarray(shown)

    def halve(
        self,
        respond: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
        omega: np.ndarray,
        L: np.ndarray,
        dL: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return samples of L and its slope, and more between those where |L| may fall below the least."""
        # a response that passes 0 has a root next to it each time, most of them too small: all are computed at once,
        # which takes far less time than to refine one root after the other
        for _ in range(HALVINGS):
            shown = self.show(omega, L, dL)[1] & (self._bound(omega, L, dL)[0] < self.least)
            if not shown.any():
                break
            omega, L, dL = self._insert(respond, shown, omega, L, dL)
        return omega, L, dL

    def leave_smaller(
        self,
        respond: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
        omega: np.ndarray,
        L: np.ndarray,
        dL: np.ndarray,
    ) -> tuple[_Search, np.ndarray, np.ndarray, np.ndarray]:
        """Return the search for fewer of many roots with |L| < 1, and samples: the largest |L| of them decides."""
        # a root that is certain, between samples of both signs, has an |L| above the lower bound there; those with an
        # upper bound below it are left out
        search = self
        for _ in range(NARROWINGS):
            h, shown = search.show(omega, L, dL)
            low, high = self._bound(omega, L, dL)
            shown &= high < 1.0
            if np.count_nonzero(shown) <= MANY:
                break
            certain = shown & (h[:-1] * h[1:] < 0)
            if self.wanted is not None:
                wanted = self.wanted(L)
                certain &= wanted[:-1] & wanted[1:]
            least = float(np.max(low[certain], initial=0.0)) * (1.0 - 1e-6)  # nearly equal ones are a kink
            search = replace(search, least=max(search.least, least))
            omega, L, dL = self._insert(respond, shown, omega, L, dL)
        return search, omega, L, dL

    @staticmethod
    def _insert(
        respond: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
        where: np.ndarray,
        omega: np.ndarray,
        L: np.ndarray,
        dL: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return samples with one more in the middle of some steps."""
        after = np.flatnonzero(where) + 1
        between = np.sqrt(omega[after - 1] * omega[after])
        new = (between, *respond(between))
        one, two, three = (np.insert(a, after, b) for a, b in zip((omega, L, dL), new, strict=True))
        return one, two, three

    @staticmethod
    def _bound(omega: np.ndarray, L: np.ndarray, dL: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds of |L| between samples, from below and above.

        From the nearer sample it changes by half a step times its slope, which may be twice as large in between.
        """
        with np.errstate(all="ignore"):
            step, size, slope = np.log(omega[1:] / omega[:-1]), np.abs(L), np.abs(dL)
            change = step * np.maximum(slope[:-1], slope[1:])
            return np.minimum(size[:-1], size[1:]) - change, np.maximum(size[:-1], size[1:]) + change


class LoopScan:
    """Frequency response of a loop with one channel, sampled once; crossings and peaks are refined from the samples."""

    def __init__(self, r: LoopModel, *, floor: float = 0.0):
        self.r, self.features, self.floor = r, r.features, floor
        self.segments = make_grid(r, floor=floor)
        if floor:
            self.segments = _leave_small(r, self.segments, 0.5 * floor)
        self.samples = [self._response(omega) for omega in self.segments]

    @classmethod
    def of(cls, r: LoopModel) -> LoopScan:
        """Return the scan of a loop; of one with delays down to a size of |L| below which no crossing decides."""
        if not r.late:
            return cls(r)
        size = 1.0
        if not any(a.omega == 0.0 for a in r.features.axis_poles):  # L(0) may be 0: of a washout, of a cancelled delay
            bends = np.append(0.0, np.abs(r.features.points()))
            size = float(np.clip(np.max(np.abs(r.matrix(1j * bends)[:, 0, 0])), 1e-3, 1.0))
        for part in FLOORS:
            scan = cls(r, floor=part * size)
            if np.isfinite(r.settled) or any(scan.floor <= abs(c.L) < 1.0 for c in scan.phase_crossovers):
                break  # one that turns up to infinite frequency is scanned as far as it changes
            if all(np.all(np.abs(L) > scan.floor) for L, _ in scan.samples):
                break  # a lower floor leads to the same samples
        return scan

    def find_gain_crossovers(self) -> list[Crossing]:
        """Return the crossings of |L| = 1 by rising frequency, the ends of the axis included."""

        def gain(L: np.ndarray, dL: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return np.log(np.abs(L)), np.real(dL / L)

        search = _Search(gain, least=1.0, most=1.0) if self.floor else _Search(gain)
        inside = [self._make_crossing(omega, gain) for omega in self._find_roots(search)]
        ends = [Crossing(omega, L, 0.0, 1e-13) for omega, L in self.ends() if abs(abs(L) - 1) < 1e-13]
        return sorted(inside + ends, key=lambda c: c.omega)

    @cached_property
    def phase_crossovers(self) -> list[Crossing]:
        """Those of `find_phase_crossovers`, searched once."""
        return self.find_phase_crossovers()

    def find_phase_crossovers(self) -> list[Crossing]:
        """Return the points with L real and negative by rising frequency; also at 0, at π/T and at infinity (D < 0).

        Those with |L| below the floor are left out, but for some near it.
        """

        def sine(L: np.ndarray, dL: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return L.imag / np.abs(L), np.real(L) / np.abs(L) * np.imag(dL / L)

        search = _Search(sine, least=self.floor, wanted=lambda L: L.real < 0)
        inside = [self._make_crossing(omega, sine) for omega in self._find_roots(search)]
        found = [c for c in inside if c.L.real < 0 and c.slope != 0.0]
        zeros = {a.omega for a in self.features.axis_zeros}
        for omega, value in self.ends():
            if np.isfinite(value) and value.real < 0 and omega not in zeros and not self._is_rounding(omega, value):
                error = self.r.error(omega) if np.isfinite(omega) else self.r.end_error
                found.append(Crossing(omega, complex(value.real), 0.0, error))
        return sorted(found, key=lambda c: c.omega)

    def _is_rounding(self, omega: float, L: complex) -> bool:
        """Whether a value at an end is that of a zero there, as rounding moves it."""
        return bool(np.isfinite(omega) and abs(L) <= self.r.rounding(np.array([1j * omega]))[0])

    def ends(self) -> list[tuple[float, complex]]:
        """Return frequency and L at both ends of the axis, 0 and π/T or ∞; L is real there, infinite at a pole."""
        at = {a.omega for a in self.features.axis_poles}
        zero = complex(np.inf) if 0.0 in at else self._value(0.0)
        top = self.r.nyquist
        last = complex(self.r.D[0, 0]) if not self.r.dt else complex(np.inf) if top in at else self._value(top)
        return [(0.0, zero), (top, last)]

    def find_peak(self, a: float, b: float) -> Peak:
        """Return the largest |(a + b L)/(1 + L)|: a, b = 1, 0 is S, and 0, 1 is T."""

        def slope(L: np.ndarray, dL: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return np.real(b * dL / (a + b * L) - dL / (1 + L)), np.zeros(len(L))

        def value(L: complex) -> float:
            return abs(b) if np.isinf(L) else abs((a + b * L) / (1 + L))

        ends = [Peak(value(L), omega) for omega, L in self.ends()]
        ends += [Peak(abs(b), pole.omega) for pole in self.features.axis_poles]
        samples, spans = [(np.array([p.value for p in ends]), np.array([p.omega for p in ends]))], []
        for omega, (L, dL) in zip(self.segments, self.samples, strict=True):
            with np.errstate(all="ignore"):
                values, rise = np.abs((a + b * L) / (1 + L)), slope(L, dL)[0]
            samples.append((values, omega))
            turns = np.flatnonzero((rise[:-1] > 0) & (rise[1:] <= 0))
            spans += [(float(values[k]), (float(omega[k]), float(omega[k + 1]))) for k in turns]
        spans = sorted(spans, reverse=True)[:POLISHED]  # rounding gives a flat response many of them
        roots = [self._polish(lambda w: self._evaluate(slope, w, 0), span) for _, span in spans]
        samples.insert(1, (np.array([value(self._value(omega)) for omega in roots]), np.array(roots)))
        values, places = (np.concatenate(rows) for rows in zip(*samples, strict=True))
        first = int(np.flatnonzero(values >= np.nanmax(values) * (1 - 1e-12))[0])
        return Peak(float(values[first]), float(places[first]))

    def find_fall_below(self, level: float) -> float:
        """Return the lowest frequency at which |T| crosses ``level`` downwards; infinite if it never does."""

        def gain(L: np.ndarray, dL: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return np.log(np.abs(L / (1 + L)) / level), np.real(dL / (L * (1 + L)))

        falls = (omega for omega in self._find_roots(_Search(gain)) if gain(*self._response(omega))[1][0] < 0)
        return next(falls, np.inf)

    def _response(self, omega: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """Return L and dL/d(log ω)."""
        L, dL = self.r.response(omega)
        return L, dL * omega

    def _value(self, omega: float) -> complex:
        return complex(self.r.matrix(1j * np.array([omega]))[0, 0, 0])

    def _make_crossing(self, omega: float, function: Function) -> Crossing:
        L, dL = self._response(omega)
        return Crossing(omega, complex(L[0]), float(function(L, dL)[1][0]), self.r.error(omega))

    def _find_roots(self, looked_for: _Search) -> Iterator[float]:
        """Yield the roots of a function by rising frequency; its slope shows two of them between two samples."""
        function, last = looked_for.function, -np.inf
        for omega, (L, dL) in zip(self.segments, self.samples, strict=True):
            search = looked_for
            if 0.0 < search.least < search.most:
                omega, L, dL = search.halve(self._response, omega, L, dL)
                if np.isinf(self.r.settled):  # else the first ones are shown
                    search, omega, L, dL = search.leave_smaller(self._response, omega, L, dL)
            h, shown = search.show(omega, L, dL)
            searched = 0
            for k in np.flatnonzero(shown).tolist():
                if k < searched:
                    continue
                span = (float(omega[k]), float(omega[k + 1]))
                left, right = h[k], h[k + 1]
                if max(abs(left), abs(right)) <= float(np.max(self._find_rounding(omega[k : k + 2], L[k : k + 2]))):
                    before, behind = self._leave_rounding(omega, L, h, k)
                    searched = len(omega) if behind is None else behind
                    if before is not None and behind is not None and h[before] * h[behind] < 0:
                        span = float(omega[before]), float(omega[behind])  # both samples are too close to the root
                        if not last > span[0]:  # rounding may have shown it before the first
                            yield (last := self._polish(lambda w: self._evaluate(function, w, 0), span))
                    continue
                if left == 0.0:
                    yield (last := span[0])
                elif left * right < 0:
                    yield (last := self._polish(lambda w: self._evaluate(function, w, 0), span))
                elif right != 0.0:  # the function turns in between
                    turn = self._polish(lambda w: self._evaluate(function, w, 1), span)
                    if self._evaluate(function, turn, 0) * left < 0:
                        yield self._polish(lambda w: self._evaluate(function, w, 0), (span[0], turn))
                        yield (last := self._polish(lambda w: self._evaluate(function, w, 0), (turn, span[1])))

    def _find_rounding(self, omega: np.ndarray, L: np.ndarray) -> np.ndarray:
        """Return bounds of the relative rounding error of L at frequencies, at least that of a constant.

        Next to a pole on the axis it turns the phase, and a crossing that is less than it isn't there.
        """
        return np.asarray(np.maximum(1e-11, self.r.rounding(1j * omega) / np.abs(L)))

    def _leave_rounding(self, omega: np.ndarray, L: np.ndarray, h: np.ndarray, k: int) -> tuple[int | None, int | None]:
        """Return the nearest samples up to k and behind it that are more than rounding, where there are such."""
        with np.errstate(all="ignore"):
            shows = ~(np.abs(h) <= self._find_rounding(omega, L))
        before, behind = np.flatnonzero(shows[: k + 1]), k + 1 + np.flatnonzero(shows[k + 1 :])
        return (int(before[-1]) if before.size else None), (int(behind[0]) if behind.size else None)

    def _evaluate(self, function: Function, omega: float, which: int) -> float:
        """Return the value (0) or the slope (1) of a function."""
        return float(function(*self._response(omega))[which][0])

    @staticmethod
    def _polish(function: Callable[[float], float], span: tuple[float, float]) -> float:
        low, high = (float(np.log(omega)) for omega in span)
        return float(np.exp(refine_sign_change(lambda x: function(np.exp(x)), low, high, xtol=1e-14)))


def make_grid(r: LoopModel, *, delay: float = 0.0, floor: float = 0.0) -> list[np.ndarray]:
    """Return segments of frequencies in rad/s that resolve every pole and zero, cut at those on the axis.

    The grid has 40 points a decade, and more around each pole and zero in proportion to its distance from the axis. It
    is then bisected until the response L e^(−jω delay) turns by less than 0.15 rad and changes by less than 0.3 in its
    logarithm from one point to the next. A delay turns a response without end: where |L| is below ``floor`` that is
    left out, with a delay in series below 0.3.
    """
    floor = max(floor, TURNS_MATTER) if delay else floor
    features = r.features
    sizes = features.sizes()
    low, high = (sizes[0] / 1e4, sizes[-1] * 1e4) if len(sizes) else (1e-3, 1e3)
    high = r.nyquist if r.dt else min(high, r.settled)
    low = min(low, high / 10)
    on_axis = (*features.axis_poles, *features.axis_zeros)
    low = max([low, *(30 * a.scatter for a in on_axis if a.omega == 0.0)])
    low = min(low, high / 10)
    grid = [np.geomspace(low, high, max(2, int(PER_DECADE * np.log10(high / low))))]
    for s in features.points():
        grid.append(abs(s.imag) + abs(s.real) * SIDES)
        grid.append(abs(s) * (1 + 0.1 * np.arange(-3, 4)))
    close = 10.0 ** np.arange(-8, 0)
    grid.extend(a.omega * (1 + np.concatenate([-close, close])) for a in on_axis)
    omega = np.concatenate(grid)
    omega = np.unique(omega[(omega >= low) & (omega <= high)])
    cuts = sorted((a.omega, a.gap) for a in on_axis if low < a.omega)
    segments, start = [], low
    for cut, gap in [*cuts, (np.inf, 0.0)]:
        end = cut * (1 - gap) if np.isfinite(cut) else high
        inside = omega[(omega > start) & (omega < min(end, high))]
        if start < min(end, high):
            segments.append(_bisect(r, np.array([start, *inside, min(end, high)]), delay, floor))
        start = max(start, cut * (1 + gap))
    return segments


def _leave_small(r: LoopModel, segments: list[np.ndarray], size: float) -> list[np.ndarray]:
    """Return segments without the frequencies behind the last at which |L| is above a size, and one more."""
    last = [np.flatnonzero(np.abs(r.matrix(1j * omega)[:, 0, 0]) > size) for omega in segments]
    most = max((k for k, found in enumerate(last) if found.size), default=0)
    end = int(last[most][-1]) + 2 if last[most].size else 2
    return [*segments[:most], segments[most][:end]]


def _bisect(r: LoopModel, omega: np.ndarray, delay: float, floor: float) -> np.ndarray:
    def respond(at: np.ndarray) -> np.ndarray:
        return np.asarray(r.matrix(1j * at)[:, 0, 0] * np.exp(-1j * at * delay))

    L, late = respond(omega), delay + r.late
    for _ in range(14):
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.log(L[1:] / L[:-1])
        apart = np.diff(omega)
        smooth = (
            (np.abs(step.real) < 0.3) & (np.abs(step.imag) < 0.15) & (apart * late < 1.0)
        )  # a whole turn shows none
        coarse = ~smooth & (apart > 1e-12 * omega[1:])
        if floor:
            coarse &= np.maximum(np.abs(L[1:]), np.abs(L[:-1])) > floor
        if not coarse.any() or len(omega) > 40_000:
            break
        between, after = np.sqrt(omega[1:] * omega[:-1])[coarse], np.flatnonzero(coarse) + 1
        omega, L = np.insert(omega, after, between), np.insert(L, after, respond(between))
    return omega
