"""Crossings and peaks of a loop's frequency response, as polished roots."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from .features import Features, scan
from .realization import Realization

Function = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]  # of L and dL/d(log ω): value, slope
POLISHED = 20  # candidates of a peak that are polished


@dataclass(frozen=True)
class Crossing:
    """A frequency at which a loop crosses the unit circle or the negative real axis.

    Parameters
    ----------
    omega : float
        The frequency, rad/s.
    L : complex
        The loop there.
    slope : float
        How the polished function rises there, per unit of log ω; zero at the ends of the axis.
    error : float
        Relative rounding error of L there.
    """

    omega: float
    L: complex
    slope: float
    error: float

    @property
    def tolerance(self) -> float:
        """Bound of the relative error of the frequency, and of L along the curve."""
        return max(1e-12, self.error * (1 + 3 / abs(self.slope)) if self.slope else 3 * self.error)


@dataclass(frozen=True)
class Peak:
    """The largest value of a function of frequency, and where it is taken (rad/s)."""

    value: float
    omega: float


class Scan:
    """A loop with one channel, scanned once; all crossings and peaks are roots polished from there.

    Parameters
    ----------
    r : Realization
        The loop.
    """

    def __init__(self, r: Realization):
        self.r = r
        self.features = Features.of(r)
        self.segments = scan(r, self.features)
        self.samples = [self._response(omega) for omega in self.segments]

    def gain_crossovers(self) -> list[Crossing]:
        """Return where |L| = 1, by rising frequency; also where it begins or ends there."""

        def gain(L: np.ndarray, dL: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return np.log(np.abs(L)), np.real(dL / L)

        inside = [self._crossing(omega, gain) for omega in self._roots(gain)]
        ends = [Crossing(omega, L, 0.0, 1e-13) for omega, L in self.ends() if abs(abs(L) - 1) < 1e-13]
        return sorted(inside + ends, key=lambda c: c.omega)

    def phase_crossovers(self) -> list[Crossing]:
        """Return where L is real and negative, by rising frequency; also at 0, at π/T, and at infinity (D < 0)."""

        def sine(L: np.ndarray, dL: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return L.imag / np.abs(L), np.real(L) / np.abs(L) * np.imag(dL / L)

        inside = [self._crossing(omega, sine) for omega in self._roots(sine)]
        found = [c for c in inside if c.L.real < 0 and c.slope != 0.0]
        zeros = {a.omega for a in self.features.axis_zeros}
        for omega, value in self.ends():
            if np.isfinite(value) and value.real < 0 and omega not in zeros:
                error = self.r.error(omega) if np.isfinite(omega) else 1e-15
                found.append(Crossing(omega, complex(value.real), 0.0, error))
        return sorted(found, key=lambda c: c.omega)

    def ends(self) -> list[tuple[float, complex]]:
        """Return L at ω = 0 and at π/T or infinity, where it is real; infinite at a pole."""
        at = {a.omega for a in self.features.axis_poles}
        zero = complex(np.inf) if 0.0 in at else self._value(0.0)
        top = self.r.nyquist
        last = complex(self.r.D[0, 0]) if not self.r.dt else complex(np.inf) if top in at else self._value(top)
        return [(0.0, zero), (top, last)]

    def peak(self, a: float, b: float) -> Peak:
        """Return the largest |(a + b L)/(1 + L)|: S is a, b = 1, 0, and T is 0, 1."""

        def slope(L: np.ndarray, dL: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return np.real(b * dL / (a + b * L) - dL / (1 + L)), np.zeros(len(L))

        def value(L: complex) -> float:
            return abs(b) if np.isinf(L) else abs((a + b * L) / (1 + L))

        ends = [Peak(value(L), omega) for omega, L in self.ends()]
        ends += [Peak(abs(b), pole.omega) for pole in self.features.axis_poles]
        samples, spans = [], []
        for omega, (L, dL) in zip(self.segments, self.samples, strict=True):
            with np.errstate(all="ignore"):
                values, rise = np.abs((a + b * L) / (1 + L)), slope(L, dL)[0]
            samples += [Peak(float(v), float(w)) for v, w in zip(values, omega, strict=True)]
            turns = np.flatnonzero((rise[:-1] > 0) & (rise[1:] <= 0))
            spans += [(float(values[k]), (float(omega[k]), float(omega[k + 1]))) for k in turns]
        spans = sorted(spans, reverse=True)[:POLISHED]  # a flat response turns often, by rounding
        roots = [self._polish(lambda w: self._at(slope, w, 0), span) for _, span in spans]
        polished = [Peak(value(self._value(omega)), omega) for omega in roots]
        found = [*ends, *polished, *samples]
        best = max(p.value for p in found)
        return next(p for p in found if p.value >= best * (1 - 1e-12))

    def falls_below(self, level: float) -> float:
        """Return the lowest frequency at which |T| crosses ``level`` downwards; infinite if it never does."""

        def gain(L: np.ndarray, dL: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return np.log(np.abs(L / (1 + L)) / level), np.real(dL / (L * (1 + L)))

        roots = [omega for omega in self._roots(gain) if gain(*self._response(omega))[1][0] < 0]
        return min(roots, default=np.inf)

    def _response(self, omega: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return L and dL/d(log ω)."""
        L, dL = self.r.response(omega)
        return L, dL * omega

    def _value(self, omega: float) -> complex:
        return complex(self.r.response(omega)[0][0])

    def _crossing(self, omega: float, function: Function) -> Crossing:
        L, dL = self._response(omega)
        return Crossing(omega, complex(L[0]), float(function(L, dL)[1][0]), self.r.error(omega))

    def _roots(self, function: Function) -> list[float]:
        """Return the roots of a function; two of them between two samples are found by its slope."""
        found: list[float] = []
        for omega, (L, dL) in zip(self.segments, self.samples, strict=True):
            with np.errstate(all="ignore"):
                h, slope = function(L, dL)
            for k in range(len(omega) - 1):
                span = (float(omega[k]), float(omega[k + 1]))
                left, right = h[k], h[k + 1]
                if not (np.isfinite(left) and np.isfinite(right)):
                    continue
                if left == 0.0:
                    found.append(span[0])
                elif left * right < 0:
                    if max(abs(left), abs(right)) > 1e-11:  # else the rounding of a constant
                        found.append(self._polish(lambda w: self._at(function, w, 0), span))
                elif left * slope[k] < 0 and right * slope[k + 1] > 0:
                    turn = self._polish(lambda w: self._at(function, w, 1), span)
                    if self._at(function, turn, 0) * left < 0:
                        found.append(self._polish(lambda w: self._at(function, w, 0), (span[0], turn)))
                        found.append(self._polish(lambda w: self._at(function, w, 0), (turn, span[1])))
        return found

    def _at(self, function: Function, omega: float, which: int) -> float:
        return float(function(*self._response(omega))[which][0])

    @staticmethod
    def _polish(function: Callable[[float], float], span: tuple[float, float]) -> float:
        from scipy.optimize import brentq

        low, high = np.log(span[0]), np.log(span[1])
        ends = function(np.exp(low)), function(np.exp(high))
        if ends[0] * ends[1] > 0:  # the ends moved by rounding: the root is at one of them
            return span[0] if abs(ends[0]) < abs(ends[1]) else span[1]
        return float(np.exp(brentq(lambda x: function(np.exp(x)), low, high, xtol=1e-14, rtol=1e-14)))
