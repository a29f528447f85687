"""The search for events within a step of the solver.

The indicators are evaluated at a few instants of each step, no further apart than two ticks or a source's time scale,
and, after an event, at instants that come geometrically closer to it, all in one pass. An indicator that is closest to
zero between two of them is followed to where it is closest. Each change of domain that fires is then located on the
step's dense output with Brent's method, to the resolution of floating point, on the side where the domain has changed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from ...blocks.core import SimulationError
from ..solvers import AcceptedStep

_SAMPLES = 4
_HALVINGS = 40
_CLOSE = 1e-3
_FEW, _MOST = 48, 1024  # instants that are evaluated in one pass: the first one, and at most
_PARTS = 0.5 ** np.arange(_HALVINGS, 0, -1)

Many = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
Known = tuple[int, np.ndarray]
"""Number of an instant, and the domains from there on."""


class Found(NamedTuple):
    """An instant at which events fire: its time, the domains before and at it, and values of the indicators around it.

    ``values`` are the larger ones of both sides of a root, 0 for an indicator that was not followed to its root.
    """

    t: float
    before: np.ndarray
    now: np.ndarray
    values: np.ndarray


class Rule(Protocol):
    """The rule by which values of indicators change domains and fire; `Domains` is one."""

    domain: np.ndarray
    """Domains of all indicators: 1 above zero, −1 below, 0 on the border."""
    has_hysteresis: np.ndarray
    """Which events have a hysteresis."""

    @property
    def g(self) -> Callable[[float, np.ndarray], np.ndarray]:
        """Return ``g(t, x)``: the indicators, at a time and the continuous states."""

    def bounds(self, domain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the largest value of each indicator that leaves it in its domain."""

    def domains_of(self, z: np.ndarray, before: np.ndarray, opened: np.ndarray | None = None) -> np.ndarray:
        """Return the domains at values of the indicators, from those before."""

    def domains_at(self, z: np.ndarray, before: np.ndarray) -> np.ndarray:
        """Return the domains at an instant at which events may fire."""

    def fires(self, before: np.ndarray, now: np.ndarray) -> np.ndarray:
        """Return which events a change of domains fires."""

    def take(self, now: np.ndarray) -> None:
        """Take over domains that fire nothing."""

    def look_at(self, size: np.ndarray, scatter: np.ndarray) -> None:
        """Note the largest values of the indicators in a step that is searched, and how they scatter at its start."""

    def outside(self, z: np.ndarray, domain: np.ndarray) -> np.ndarray:
        """Return which values, one instant a row, are outside of the bounds of their domains."""


class EventSearch:
    """The search for the first event of a step.

    Parameters
    ----------
    domains : Rule
        The rule by which values of indicators change domains and fire.
    many : callable
        ``many(times, states)``: the indicators, shape (times, events), and 1 where their subsystems are open.
    spacing : float
        Longest time in s between two instants at which indicators are evaluated.
    """

    def __init__(self, domains: Rule, many: Many, spacing: float):
        self._rule, self._many, self._spacing = domains, many, spacing
        self._finest = 2e-16 * spacing
        self.fresh = True
        """Whether an event has fired since the last step without one: others may follow closely."""

    def first_event(self, step: AcceptedStep) -> Found | None:
        """Return the first instant in (t_old, t] at which events fire; if none does, None: domains are those at t."""
        instants = self._instants(step.t_old, step.t)
        first, width = 1, _FEW
        while first < len(instants):
            found = self._first_among(step, instants[max(0, first - 2) : first + width], min(first, 2))
            if found is not None:
                return found
            first, width = first + width, min(2 * width, _MOST)
        self.fresh = False
        return None

    def _instants(self, a: float, b: float) -> np.ndarray:
        n = max(_SAMPLES, math.ceil((b - a) / self._spacing))
        h = (b - a) / n
        if self.fresh:  # an indicator may be back across zero within a small part of the step
            close = a + h * _PARTS
            close = close[(close > a) & (close < a + h)]
        else:
            close = np.array([a + _CLOSE * h])  # these two tell which way it goes at the ends
        inner = a + h * np.arange(1, n)
        found = np.concatenate(([a], close, inner, [b - _CLOSE * h, b]))
        return found[np.concatenate(([True], found[1:] > found[:-1]))]

    def _first_among(self, step: AcceptedStep, times: np.ndarray, k: int) -> Found | None:
        """Look at instants from number ``k`` on; the domains known are those of the one before."""
        rule = self._rule
        z, opened = self._many(times, step.interpolate_many(times))
        bad = np.flatnonzero(np.any(~np.isfinite(z) & (opened > 0.5), axis=1))
        end = int(bad[0]) if bad.size else len(times)
        closed = None if np.all(opened > 0.5) else opened <= 0.5
        size = np.abs(z[:end]).max(axis=0)
        rule.look_at(size, _scatter(times, z) if self.fresh and k == 1 else np.zeros_like(size))
        dips = self._find_dips(times[:end], z[:end])
        known = [(0, rule.domain)]  # the instants from which on the domains were others, and these
        while k < end:
            now = known[-1][1]
            out = rule.outside(z[k:end], now)
            if closed is not None:
                out &= ~closed[k:end]
            rows = out.any(axis=1)
            stop = k + int(rows.argmax()) if rows.any() else end
            for dip in (d for d in dips if k <= d < stop):
                ends = self._follow_dips(step, times, z, dip, dips[dip], known)
                if ends:
                    return self._earliest(step, times, dip, ends, known)
            if stop == end:
                break
            b = float(times[stop])
            z[stop] = rule.g(b, step.interpolate(b))  # as the run will see it, to the last bit
            changed = rule.domains_of(z[stop], now)
            known.append((stop, changed))
            ends = [(int(i), float(times[stop - 1]), b) for i in np.flatnonzero(rule.fires(now, changed))]
            if stop in dips:
                ends += self._follow_dips(step, times, z, stop, dips[stop], known)
            if ends:
                return self._earliest(step, times, stop, ends, known)
            k = stop + 1
        rule.take(known[-1][1])
        if bad.size:
            t = float(times[end])
            rule.g(t, step.interpolate(t))  # raises
        return None

    def _earliest(
        self,
        step: AcceptedStep,
        times: np.ndarray,
        last: int,
        ends: list[tuple[int, float, float]],
        known: list[Known],
    ) -> Found:
        """Return the first of the events that lie between the given ends, before instant number ``last``."""
        found, values = math.inf, np.zeros(len(self._rule.domain))
        for i, low, high in ends:
            start = _domains_at(known, int(np.searchsorted(times, low, side="right")) - 1)
            t, values[i] = self._find_root(i, low, high, step, start)
            found = min(found, t)
        at = min(int(np.searchsorted(times, found, side="right")) - 1, last - 1)
        before = _domains_at(known, at)
        now = self._rule.domains_at(self._rule.g(found, step.interpolate(found)), before)
        return Found(found, before, now, values)

    # --- excursions --------------------------------------------------------------------------------------------------

    def _find_dips(self, times: np.ndarray, z: np.ndarray) -> dict[int, np.ndarray]:
        """Return the indicators that may have been in the other domain between three instants, by the last of these.

        Where the middle one is closest to zero, the parabola through the three tells how close it may come in between.
        """
        if len(times) < 3:
            return {}
        size = np.abs(z)
        near = (size[1:-1] <= size[:-2]) & (size[1:-1] <= size[2:])
        up = z > 0.0
        near &= ((up[1:-1] == up[:-2]) & (up[1:-1] == up[2:])) | self._rule.has_hysteresis
        dips = {}
        for k in np.flatnonzero(near.any(axis=1)).tolist():
            h0, h1 = float(times[k + 1] - times[k]), float(times[k + 2] - times[k + 1])
            slope0, slope1 = (z[k + 1] - z[k]) / h0, (z[k + 2] - z[k + 1]) / h1
            bend = (slope1 - slope0) / (h0 + h1)
            tangent = slope0 + bend * h0
            with np.errstate(all="ignore"):
                lowest = z[k + 1] - tangent * tangent / (4.0 * bend)
            far = ((lowest > 0.0) == (z[k + 1] > 0.0)) & (np.abs(lowest) > 0.3 * np.maximum(size[k], size[k + 2]))
            which = np.flatnonzero(near[k] & np.isfinite(bend) & (bend != 0.0) & ~far)
            if which.size:
                dips[k + 2] = which
        return dips

    def _follow_dips(
        self, step: AcceptedStep, times: np.ndarray, z: np.ndarray, k: int, which: np.ndarray, known: list[Known]
    ) -> list[tuple[int, float, float]]:
        """Return those that were in the other domain between instants k − 2 and k, and between which times to look."""
        first, last = float(times[k - 2]), float(times[k])
        before, middle, after = (_domains_at(known, j) for j in (k - 2, k - 1, k))
        found = []
        for i in which:
            if not before[i] == middle[i] == after[i] != 0:
                continue
            t = self._find_closest(int(i), int(middle[i]), first, last, step)
            now = self._rule.domains_of(self._rule.g(t, step.interpolate(t)), middle)
            if now[i] != middle[i] and first < t < last and self._rule.fires(middle, now)[i]:
                found.append((int(i), first, t))
        return found

    def _find_closest(self, i: int, side: int, low: float, high: float, step: AcceptedStep) -> float:
        """Return the instant at which an indicator is closest to the other domain."""
        from scipy.optimize import minimize_scalar

        g = self._rule.g
        best = minimize_scalar(
            lambda t: side * g(t, step.interpolate(t))[i], bounds=(low, high), method="bounded", options={"xatol": 0.0}
        )
        return float(best.x)

    # --- location ----------------------------------------------------------------------------------------------------

    def _find_root(self, i: int, a: float, b: float, step: AcceptedStep, before: np.ndarray) -> tuple[float, float]:
        """Return the time at which indicator ``i`` has just left its domain, between a and b, where it has.

        Also the larger one of its distances from there on both sides.
        """
        g = self._rule.g
        low, high = (float(bound[i]) for bound in self._rule.bounds(before))
        values: dict[float, float] = {}

        def value(t: float) -> float:
            if t not in values:
                values[t] = float(g(t, step.interpolate(t))[i])
            return values[t]

        def is_changed(t: float) -> bool:
            return not low <= value(t) <= high

        if is_changed(a):  # it was taken over at a already; the step begins beyond
            return a, 0.0
        level = high if value(b) > high else low
        za, zb = value(a) - level, value(b) - level
        if za == 0.0 or not za * zb < 0.0:
            t = b
            while t - a > max(4 * math.ulp(t), self._finest):
                middle = 0.5 * (a + t)
                a, t = (a, middle) if is_changed(middle) else (middle, t)
        else:
            from scipy.optimize import brentq

            resolution = max(4 * math.ulp(max(abs(a), abs(b))), self._finest)
            t = float(brentq(lambda t: value(t) - level, a, b, xtol=resolution, rtol=1e-15, maxiter=200))
            ahead = max(math.ulp(t), self._finest)
            while t < b and not is_changed(t):
                t, ahead = min(b, t + ahead), 2 * ahead
        below = max(a, t - max(4 * math.ulp(t), self._finest))
        return t, max(abs(value(t) - level), abs(value(below) - level))


def evaluate_many(
    g: Callable[[float, np.ndarray], np.ndarray], opened: np.ndarray, times: np.ndarray, states: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return indicators at several times, one row each, NaN beyond a failure, and what ``g`` writes into ``opened``."""
    n = len(opened)
    z, open_then = np.full((len(times), n), math.nan), np.ones((len(times), n))
    try:
        for k, t in enumerate(times.tolist()):
            z[k] = g(t, states[k])
            open_then[k] = opened
    except SimulationError:  # a loop without a solution: whoever needs that instant evaluates it again
        z[k:], open_then[k:] = math.nan, 1.0
    return z, open_then


def _scatter(times: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return how far values of the indicators are from straight lines, where a step begins: rounding errors."""
    m = _HALVINGS // 3
    if len(times) <= m + 1:
        return np.zeros(z.shape[1])
    line = np.outer((times[1:m] - times[0]) / (times[m] - times[0]), z[m] - z[0])
    return np.asarray(np.max(np.abs(z[1:m] - z[0] - line), axis=0))


def _domains_at(known: list[Known], k: int) -> np.ndarray:
    """Return the domains at instant number k."""
    return next(domains for since, domains in reversed(known) if since <= k)
