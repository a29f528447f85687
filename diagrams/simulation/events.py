"""Events in continuous time: when an indicator changes its domain, and what happens then.

An indicator is in one of two domains, z > 0 or z ≤ 0 (with a hysteresis δ it leaves the first at z ≤ −δ, the second at
z > δ). A change in the declared direction fires. Changes are looked for at a few instants inside each step of the
solver, no further apart than two ticks or a source's time scale, and, after an event, at instants that come
geometrically closer to it; an indicator that is closest to zero between two of them is followed to where it is closest;
each is then located on the step's dense output with Brent's method, to the resolution of floating point, on the side
where the domain has changed.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ...blocks.core import SimulationError
from ..flat import FlatDiagram

_SAMPLES = 4
_HALVINGS = 40
_CLOSE = 1e-3
_SAME_INSTANT = 100  # events that fire each other at one instant
_CHATTER, _SPAN = 500, 1e-8  # so many events within so many seconds (relative to 1 + |t|)
_ZENO, _SHRUNK = 8, 1e-6  # intervals that shrink from one to the next, down to this part of the largest one


class Domains:
    """The domains of all indicators, and the events that changes of them fire."""

    def __init__(
        self,
        flat: FlatDiagram,
        g: Callable[[float, np.ndarray], np.ndarray],
        opened: np.ndarray,
        time_scale: float = math.inf,
    ):
        self.events, self._g, self._open = flat.events, g, opened
        self._spacing = min(float(flat.base), time_scale)
        self._finest = 2e-16 * self._spacing
        self.rising = np.array([e.direction != "falling" for e in flat.events])
        self.falling = np.array([e.direction != "rising" for e in flat.events])
        self._hysteresis = np.array([e.hysteresis for e in flat.events])
        self.above = np.zeros(len(flat.events), dtype=bool)
        self._first = self.above
        self.fresh = True
        self._times = [deque[float](maxlen=_ZENO + 1) for _ in flat.events]
        self._largest = np.zeros(len(flat.events))
        self._recent = deque[tuple[float, tuple[int, ...]]](maxlen=_CHATTER)

    def _domains(self, t: float, x: np.ndarray, before: np.ndarray) -> np.ndarray:
        return self._domains_of(self._g(t, x), before)

    def _domains_of(self, z: np.ndarray, before: np.ndarray) -> np.ndarray:
        """Return the domains at the values z of the indicators that were evaluated last."""
        now = z > np.where(before, -self._hysteresis, self._hysteresis)
        return np.where(self._open > 0.5, now, before)  # a closed subsystem holds its domains, too

    def begin(self, t: float, x: np.ndarray) -> None:
        """Take the domains as they are; nothing fires."""
        self.above = self._first = np.array(self._g(t, x) > 0.0)

    def reset(self, subsystem: str) -> None:
        """Go back to the domains of the start for the blocks in a subsystem whose states have done so."""
        inside = np.array([e.path.startswith(f"{subsystem}.") and not e.subsystem for e in self.events])
        self.above = np.where(inside, self._first, self.above)

    def update(self, t: float, x: np.ndarray) -> np.ndarray:
        """Take over the domains at one instant, and return which events their changes fire."""
        now = self._domains(t, x, self.above)
        fired = self._fires(self.above, now)
        self.above = now
        return fired

    def _fires(self, before: np.ndarray, now: np.ndarray) -> np.ndarray:
        up, down = now & ~before & self.rising, before & ~now & self.falling
        return np.array(up | down)

    def locate(
        self, t_old: float, t_new: float, state: Callable[[float], np.ndarray]
    ) -> tuple[float, np.ndarray] | None:
        """Return the first instant in (t_old, t_new] at which events fire, and which; None if none does.

        Parameters
        ----------
        state : callable
            The continuous states at a time within the step.
        """
        a = t_old
        seen = [(t_old, self._values(t_old, state), self.above)]  # the last two instants, indicators and domains there
        for b in self._instants(t_old, t_new):
            z = self._values(b, state)
            now = self._domains_of(z, self.above)
            fires = self._fires(self.above, now)
            ends = [(int(i), a, b) for i in np.flatnonzero(fires)]
            if len(seen) > 1:
                ends += self._find_excursions(seen, b, z, now, state)
            if ends:
                t = min(self._find_root(i, low, high, state) for i, low, high in ends)
                before = next(above for at, _, above in reversed([*seen, (math.inf, z, now)]) if at <= t)
                now = self._domains(t, state(t), before)
                self.above = now
                return t, self._fires(before, now)
            self.above = now
            seen = [seen[-1], (b, z, now)]
            a = b
        self.fresh = False
        return None

    def _find_excursions(
        self, seen: list[Any], b: float, z: np.ndarray, now: np.ndarray, state: Callable[[float], np.ndarray]
    ) -> list[tuple[int, float, float]]:
        """Return the indicators that go to the other domain and back between three instants, and where to look.

        Where the middle one is closest to zero, the parabola through the three tells how close it may come in between.
        """
        (first, z0, above0), (middle, z1, above1) = seen
        if not first < middle < b:
            return []
        size0, size1, size2 = np.abs(z0), np.abs(z1), np.abs(z)
        near = (size1 <= size0) & (size1 <= size2) & (above0 == above1) & (above1 == now)
        found = []
        for i in np.flatnonzero(near):
            h0, h1 = middle - first, b - middle
            slope0, slope1 = (z1[i] - z0[i]) / h0, (z[i] - z1[i]) / h1
            bend = (slope1 - slope0) / (h0 + h1)
            if bend == 0.0 or not math.isfinite(bend):
                continue
            tangent = slope0 + bend * h0
            lowest = z1[i] - tangent * tangent / (4.0 * bend)
            if (lowest > 0.0) == (z1[i] > 0.0) and abs(lowest) > 0.3 * max(size0[i], size2[i]):
                continue
            t = self._find_closest(int(i), first, b, state)
            if self._domains_of(self._values(t, state), above1)[i] != above1[i] and first < t < b:
                found.append((int(i), first, t))
        return found

    def _find_closest(self, i: int, low: float, high: float, state: Callable[[float], np.ndarray]) -> float:
        """Return the instant at which an indicator is closest to the other domain."""
        from scipy.optimize import minimize_scalar

        sign = 1.0 if self.above[i] else -1.0
        best = minimize_scalar(
            lambda t: sign * self._values(t, state)[i], bounds=(low, high), method="bounded", options={"xatol": 0.0}
        )
        return float(best.x)

    def _values(self, t: float, state: Callable[[float], np.ndarray]) -> np.ndarray:
        return np.array(self._g(t, state(t)))

    def _instants(self, a: float, b: float) -> Iterator[float]:
        n = max(_SAMPLES, math.ceil((b - a) / self._spacing))
        h = (b - a) / n
        if self.fresh:  # an indicator may be back across zero within a small part of the step
            for k in range(_HALVINGS, 0, -1):
                t = a + h * 0.5**k
                if a < t < a + h:
                    yield t
        elif a + _CLOSE * h > a:
            yield a + _CLOSE * h  # these two tell which way it goes at the ends
        for i in range(1, n):
            yield a + i * h
        if b - _CLOSE * h < b:
            yield b - _CLOSE * h
        yield b

    def _find_root(self, i: int, a: float, b: float, state: Callable[[float], np.ndarray]) -> float:
        """Return the time at which indicator ``i`` has just changed its domain, between a and b."""
        level = -self._hysteresis[i] if self.above[i] else self._hysteresis[i]
        was = bool(self.above[i])

        def z(t: float) -> float:
            return float(self._g(t, state(t))[i] - level)

        def is_changed(t: float) -> bool:
            return (z(t) > 0.0) != was

        za, zb = z(a), z(b)
        if is_changed(a):  # it was taken over at a already; the step begins beyond
            return a
        if za == 0.0 or not za * zb < 0.0:
            low, high = a, b
            while high - low > max(4 * math.ulp(high), self._finest):
                middle = 0.5 * (low + high)
                low, high = (low, middle) if is_changed(middle) else (middle, high)
            return high
        from scipy.optimize import brentq

        t = float(brentq(z, a, b, xtol=max(4 * math.ulp(max(abs(a), abs(b))), self._finest), rtol=1e-15, maxiter=200))
        step = max(math.ulp(t), self._finest)
        while t < b and not is_changed(t):
            t, step = min(b, t + step), 2 * step
        return t

    # --- never a hang ------------------------------------------------------------------------------------------------

    def count(self, t: float, fired: np.ndarray, diagram: str) -> None:
        """Note that events fired.

        Raises
        ------
        SimulationError
            If they pile up: chattering, or Zeno behaviour.
        """
        self.fresh = True
        for i in np.flatnonzero(fired):
            times = self._times[i]
            if times:
                self._largest[i] = max(self._largest[i], t - times[-1])
            times.append(t)
            self._look_for_zeno(int(i))
        self._recent.append((t, tuple(np.flatnonzero(fired).tolist())))
        if len(self._recent) == _CHATTER and t - self._recent[0][0] < _SPAN * (1.0 + abs(t)):
            counts = np.bincount([i for _, together in self._recent for i in together])
            event = self.events[int(np.argmax(counts))]
            raise SimulationError(
                f"the event {event.name!r} chatters: {_CHATTER} times events fired within "
                f"{t - self._recent[0][0]:.2g} s, so the run would not go on. "
                "What it switches drives the indicator back across zero at once. Declare "
                "a hysteresis, Event(hysteresis=…), or take a block that has one, such as Relay.",
                block=event.path,
                t=t,
            )

    def _look_for_zeno(self, i: int) -> None:
        times = self._times[i]
        if len(times) <= _ZENO:
            return
        intervals = np.diff(np.array(times))
        if not np.all(intervals > 0.0) or intervals[-1] > _SHRUNK * self._largest[i]:
            return
        r = float((intervals[-1] / intervals[0]) ** (1.0 / (len(intervals) - 1)))
        if r < 0.9999 and np.all(intervals[1:] < 1.5 * intervals[:-1]):  # by one ratio, but for what the solver adds
            event, t = self.events[i], times[-1]
            limit = t + intervals[-1] * r / (1.0 - r)
            raise SimulationError(
                f"the event {event.name!r} shows Zeno behaviour: it fires at intervals that shrink by {r:.4g} each "
                f"time, the last one {intervals[-1]:.2g} s, and would fire infinitely often before t = {limit:.9g} s. "
                "Give the model a state of rest: let its jump stop the motion below a small speed, or end the run "
                "before.",
                block=event.path,
                t=t,
            )

    def too_many(self, t: float, fired: np.ndarray) -> SimulationError:
        """Return the error of events that fire each other at one instant for ever."""
        names = ", ".join(f"{self.events[i].path}.{self.events[i].name}" for i in np.flatnonzero(fired))
        event = self.events[int(np.flatnonzero(fired)[0])]
        return SimulationError(
            f"events fire each other without end at one instant: after {_SAME_INSTANT} rounds {names} still fires. "
            "Let a jump change what the other's indicator looks at only once, or declare a hysteresis, "
            "Event(hysteresis=…).",
            block=event.path,
            t=t,
        )

    @property
    def most(self) -> int:
        """Most rounds of events that may follow each other at one instant."""
        return _SAME_INSTANT

    def save(self) -> Any:
        """Return what is needed to go on from here."""
        times = [list(d) for d in self._times]
        return self.above.copy(), self.fresh, times, self._largest.copy(), list(self._recent), self._first.copy()

    def restore(self, saved: Any) -> None:
        """Go back to what `save` returned."""
        above, self.fresh, times, largest, recent, first = saved
        self.above, self._largest, self._first = above.copy(), largest.copy(), first.copy()
        self._times = [deque(d, maxlen=_ZENO + 1) for d in times]
        self._recent = deque(recent, maxlen=_CHATTER)
