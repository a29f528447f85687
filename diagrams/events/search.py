"""The search for events within a step of the solver.

The indicators are evaluated at a few instants of each step, no further apart than two ticks or a source's time scale,
and, after an event, at instants that come geometrically closer to it, all in one pass. An indicator that is closest to
zero between two of them is followed to where it is closest. Each change of domain that fires is then located on the
step's dense output by interpolation and bisection, to the resolution of floating point, on the side where the domain
has changed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from ..solvers import AcceptedStep
from .bracket import find_root
from .many import SIZES, ManyInstants, Scan

_SAMPLES = 4
_HALVINGS = 40
_CLOSE = 1e-3
_FEW, _MOST = 48, 1024  # instants that are evaluated in one pass: the first one, and at most
_PARTS = 0.5 ** np.arange(_HALVINGS, 0, -1)
_AROUND = np.arange(-5.0, 6.0)  # instants around a root
_KEPT = 64  # divisions of a step that are remembered
_APART = 1e-15  # of the time, relative: instants that are further from each other are distinct

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

    def domains_of(self, z: np.ndarray, before: np.ndarray) -> np.ndarray:
        """Return the domains at values of the indicators, from those before."""

    def domains_at(self, z: np.ndarray, before: np.ndarray) -> np.ndarray:
        """Return the domains at an instant at which events may fire."""

    def fires(self, before: np.ndarray, now: np.ndarray) -> np.ndarray:
        """Return which events a change of domains fires."""

    def take(self, now: np.ndarray) -> None:
        """Take over domains that fire nothing."""

    @property
    def slack(self) -> np.ndarray:
        """Return the distance beyond zero to which each indicator that has just crossed it counts as beyond."""

    def slack_of(self, scatter: np.ndarray, size: np.ndarray) -> np.ndarray:
        """Return the slack of indicators that scatter so far about straight lines, with values up to the size."""

    def strict_bounds(self, domain: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Return `bounds` without slack for rounding errors; None if an indicator is on the border."""

    def pass_by(self, size: np.ndarray, later: np.ndarray) -> bool:
        """Take over a step in which nothing happened; see `Domains.pass_by`."""

    def clear(self, z: np.ndarray, distance: np.ndarray, size: np.ndarray) -> np.ndarray | None:
        """Return what `outside` does if rounding errors make no difference, else None; see `Domains.clear`."""

    def look_at(self, size: np.ndarray, scatter: np.ndarray | None) -> None:
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
        self._scan = many.scan if isinstance(many, ManyInstants) and many.scans else None
        self._finest = 2e-16 * spacing
        self._rough: Callable[[float], np.ndarray] | None = None
        self._parts: dict[tuple[int, bool], np.ndarray] = {}
        self.fresh = True
        """Whether an event has fired since the last step without one: others may follow closely."""

    def first_event(self, step: AcceptedStep) -> Found | None:
        """Return the first instant in (t_old, t] at which events fire; if none does, None: domains are those at t."""
        instants = self._instants(step.t_old, step.t)
        first, width, scan = 1, _FEW, None
        bounds = None if self._scan is None else self._rule.strict_bounds(self._rule.domain)
        if self._scan is not None and bounds is not None:
            width = SIZES[-1] - first
            scan = self._scan(step, instants[: first + width], bounds)
            quiet = scan is not None and scan.trouble == 0.0 and len(instants) <= first + width
            if quiet and scan is not None and self._rule.pass_by(scan.size, scan.later):
                self.fresh = False
                return None
        while first < len(instants):
            found = self._first_among(step, instants[max(0, first - 2) : first + width], min(first, 2), scan)
            scan = None
            if found is not None:
                return found
            first, width = first + width, min(2 * width, _MOST)
        self.fresh = False
        return None

    def _instants(self, a: float, b: float) -> np.ndarray:
        n = max(_SAMPLES, math.ceil((b - a) / self._spacing))
        h = (b - a) / n
        key = n, self.fresh
        parts = self._parts.get(key)
        if parts is None:
            if len(self._parts) > _KEPT:
                self._parts.clear()
            # after an event an indicator may be back across zero within a small part of the step; else the two close to
            # the ends tell which way it goes there
            close = _PARTS if self.fresh else [_CLOSE]
            parts = self._parts[key] = np.concatenate(([0.0], close, np.arange(1.0, n), [n - _CLOSE, n]))
        found: np.ndarray = h * parts
        found += a
        found[-2:] = b - _CLOSE * h, b
        if parts[1] * h > _APART * max(abs(a), abs(b)):
            return found
        return found[np.concatenate(([True], found[1:] > np.maximum.accumulate(found[:-1])))]

    def _first_among(self, step: AcceptedStep, times: np.ndarray, k: int, scan: Scan | None) -> Found | None:
        """Look at instants from number ``k`` on; the domains known are those of the one before."""
        rule = self._rule
        self._rough = None if scan is None else scan.value
        z, opened = self._many(times, step.interpolate_many(times)) if scan is None else scan[:2]
        closed = None if opened.min() > 0.5 else opened <= 0.5
        size, end = np.abs(z), len(times)
        largest = size.max(axis=0) if scan is None or math.isnan(scan.trouble) else scan.size
        if not math.isfinite(sum(largest.tolist())):
            bad = np.flatnonzero(np.any(~np.isfinite(z) & (opened > 0.5), axis=1))
            if bad.size:
                end = int(bad[0])
                largest = size[:end].max(axis=0)
        slack = rule.slack
        out = rule.clear(z[k:end], size[k:end], largest) if self.fresh and k == 1 and k < end else None
        if out is None:
            rule.look_at(largest, _scatter(times, z) if self.fresh and k == 1 else None)
        dips = self._find_dips(times[:end], z[:end], size[:end])
        if dips and self.fresh and k == 1:
            slack = np.maximum(slack, rule.slack_of(_scatter(times, z), largest))
        leaving = _leading_run(size[:end] <= slack) if dips and slack.any() else np.zeros(len(slack), dtype=int)
        known = [(0, rule.domain)]  # the instants from which on the domains were others, and these
        while k < end:
            now = known[-1][1]
            out = rule.outside(z[k:end], now) if out is None else out
            if closed is not None:
                out &= ~closed[k:end]
            first = int(out.argmax())  # in rows one after the other
            stop = k + first // out.shape[1] if out.flat[first] else end
            out = None
            for dip in dips:
                close = np.where(dip - 1 < leaving, slack, 0.0)
                ends = self._follow_dips(step, times, dip, dips[dip], known, close) if k <= dip < stop else []
                if ends:
                    return self._earliest(step, times, z, dip, ends, known)
            if stop == end:
                break
            b = float(times[stop])
            z[stop] = rule.g(b, step.interpolate(b))  # as the run will see it, to the last bit
            changed = rule.domains_of(z[stop], now)
            known.append((stop, changed))
            ends = [(int(i), float(times[stop - 1]), b) for i in np.flatnonzero(rule.fires(now, changed))]
            if stop in dips:
                close = np.where(stop - 1 < leaving, slack, 0.0)
                ends += self._follow_dips(step, times, stop, dips[stop], known, close)
            if ends:
                return self._earliest(step, times, z, stop, ends, known)
            k = stop + 1
        rule.take(known[-1][1])
        if end < len(times):
            t = float(times[end])
            rule.g(t, step.interpolate(t))  # raises
        return None

    def _earliest(
        self,
        step: AcceptedStep,
        times: np.ndarray,
        z: np.ndarray,
        last: int,
        ends: list[tuple[int, float, float]],
        known: list[Known],
    ) -> Found:
        """Return the first of the events that lie between the given ends, before instant number ``last``.

        There the indicators z are those of the run, to the last bit, if the last domains are known from there on.
        """
        found, values = math.inf, np.zeros(len(self._rule.domain))
        rough = self._rough
        exact = float(times[last]) if known[-1][0] == last else None
        for i, low, high in ends:
            start = _domains_at(known, int(times.searchsorted(low, side="right")) - 1)
            seen = {high: float(z[last, i])} if high == exact else {}
            t, values[i] = self._find_root(i, low, high, step, start, seen, rough)
            found = min(found, t)
        at = min(int(times.searchsorted(found, side="right")) - 1, last - 1)
        before = _domains_at(known, at)
        now = self._rule.domains_at(self._rule.g(found, step.interpolate(found)), before)
        return Found(found, before, now, values)

    # --- excursions --------------------------------------------------------------------------------------------------

    def _find_dips(self, times: np.ndarray, z: np.ndarray, size: np.ndarray) -> dict[int, np.ndarray]:
        """Return the indicators that may have been in the other domain between three instants, by the last of these.

        Where the middle one is closest to zero, the parabola through the three tells how close it may come in between.
        """
        if len(times) < 3:
            return {}
        near = (size[1:-1] <= size[:-2]) & (size[1:-1] <= size[2:])
        if not near.any():
            return {}
        up = z > 0.0
        near &= ((up[1:-1] == up[:-2]) & (up[1:-1] == up[2:])) | self._rule.has_hysteresis
        k = np.flatnonzero((near & (z[1:-1] != z[:-2]) | near & (z[1:-1] != z[2:])).any(axis=1))
        if not k.size:
            return {}
        h0, h1 = (times[k + 1] - times[k])[:, None], (times[k + 2] - times[k + 1])[:, None]
        middle = z[k + 1]
        slope0, slope1 = (middle - z[k]) / h0, (z[k + 2] - middle) / h1
        bend = (slope1 - slope0) / (h0 + h1)
        tangent = slope0 + bend * h0
        with np.errstate(all="ignore"):
            lowest = middle - tangent * tangent / (4.0 * bend)
        far = ((lowest > 0.0) == (middle > 0.0)) & (np.abs(lowest) > 0.3 * np.maximum(size[k], size[k + 2]))
        which = near[k] & np.isfinite(bend) & (bend != 0.0) & ~far
        return {int(row) + 2: np.flatnonzero(of) for row, of in zip(k, which, strict=True) if of.any()}

    def _follow_dips(
        self, step: AcceptedStep, times: np.ndarray, k: int, which: np.ndarray, known: list[Known], slack: np.ndarray
    ) -> list[tuple[int, float, float]]:
        """Return those that were in the other domain between instants k − 2 and k, and between which times to look.

        One that is just leaving zero has been there if it was further than its slack, for rounding errors carry it back
        as well: the instants tell nothing of them, as the closest of many values between these is taken.
        """
        first, last = float(times[k - 2]), float(times[k])
        before, middle, after = (_domains_at(known, j) for j in (k - 2, k - 1, k))
        found = []
        for i in which:
            if not before[i] == middle[i] == after[i] != 0:
                continue
            t = self._find_closest(int(i), int(middle[i]), first, last, step)
            z = np.array(self._rule.g(t, step.interpolate(t)))
            z[i] += middle[i] * slack[i]
            now = self._rule.domains_of(z, middle)
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

    def _find_root(
        self,
        i: int,
        a: float,
        b: float,
        step: AcceptedStep,
        before: np.ndarray,
        values: dict[float, float],
        rough: Callable[[float], np.ndarray] | None,
    ) -> tuple[float, float]:
        """Return the time at which indicator ``i`` has just left its domain, between a and b, where it has.

        Also the largest one of its distances from there on both sides and its rounding errors around it. ``values`` are
        those that are known.
        """
        g, interpolate = self._rule.g, step.interpolate
        low, high = (float(bound[i]) for bound in self._rule.bounds(before))

        def value(t: float) -> float:
            found = values.get(t)
            if found is None:
                found = values[t] = float(g(t, interpolate(t))[i])
            return found

        def near(t: float) -> float:
            found = math.nan if rough is None else float(rough(t)[i])  # it costs a fifth
            return found if math.isfinite(found) else value(t)

        def is_changed(t: float) -> bool:
            return not low <= value(t) <= high

        if is_changed(a):  # it was taken over at a already; the step begins beyond
            return a, 0.0
        level = high if value(b) > high else low
        za, zb = value(a) - level, value(b) - level
        resolution = max(4 * math.ulp(max(abs(a), abs(b))), self._finest)
        if za == 0.0 or not za * zb < 0.0:
            t = b
            while t - a > max(4 * math.ulp(t), self._finest):
                middle = 0.5 * (a + t)
                a, t = (a, middle) if is_changed(middle) else (middle, t)
        else:
            t = find_root(lambda t: near(t) - level, a, za, b, zb, resolution)
            ahead = max(math.ulp(t), self._finest)
            while t < b and not is_changed(t):
                t, ahead = min(b, t + ahead), 2 * ahead
        apart = max(4 * math.ulp(t), self._finest)
        below = max(a, t - apart)
        scatter = self._scatter_around(i, t, apart, step)
        return t, max(abs(value(t) - level), abs(value(below) - level), scatter)

    def _scatter_around(self, i: int, t: float, apart: float, step: AcceptedStep) -> float:
        """Return how far values of an indicator around its root are from a straight line: its rounding errors.

        Two values there may be close to zero by chance.
        """
        times = np.unique(np.clip(t + apart * _AROUND, step.t_old, step.t))
        if len(times) < 3:
            return 0.0
        z = self._many(times, step.interpolate_many(times))[0][:, i]
        part = (times - times[0]) / (times[-1] - times[0])
        found = float(np.abs(z - z[0] - part * (z[-1] - z[0])).max())
        return found if math.isfinite(found) else 0.0


def _scatter(times: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return how far values of the indicators are from straight lines, where a step begins: rounding errors."""
    m = _HALVINGS // 3
    if len(times) <= m + 1:
        return np.zeros(z.shape[1])
    part = (times[1:m] - times[0]) / (times[m] - times[0])
    return np.asarray(np.abs(z[1:m] - z[0] - part[:, None] * (z[m] - z[0])).max(axis=0))


def _leading_run(within: np.ndarray) -> np.ndarray:
    """Return how many rows are true from the first one on, for each column."""
    return np.where(within.all(axis=0), len(within), (~within).argmax(axis=0))


def _domains_at(known: list[Known], k: int) -> np.ndarray:
    """Return the domains at instant number k."""
    return next(domains for since, domains in reversed(known) if since <= k)
