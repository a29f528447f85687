"""Events in continuous time: when an indicator changes its domain, and what happens then.

An indicator is in one of two domains, z > 0 or z ≤ 0 (with a hysteresis δ it leaves the first at z ≤ −δ, the second at
z > δ). A change in the declared direction fires. Changes are looked for at a few instants inside each step of the
solver, no further apart than two ticks, and, after an event, at instants that come geometrically closer to it; each is
then located on the step's dense output with Brent's method, to the resolution of floating point, on the side where the
domain has changed.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ..blocks._errors import SimulationError
from ._flat import FlatDiagram

_SAMPLES = 4
_HALVINGS = 40
_SAME_INSTANT = 100  # events that fire each other at one instant
_CHATTER, _SPAN = 500, 1e-8  # so many events within so many seconds (relative to 1 + |t|)
_ZENO, _SHRUNK = 8, 1e-7  # intervals that shrink by one ratio, down to this part of the largest one


class Domains:
    """The domains of all indicators, and the events that changes of them fire."""

    def __init__(self, flat: FlatDiagram, g: Callable[[float, np.ndarray], np.ndarray], opened: np.ndarray):
        self.events, self._g, self._open = flat.events, g, opened
        self._spacing = float(flat.base)
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
        now = self._g(t, x) > np.where(before, -self._hysteresis, self._hysteresis)
        return np.where(self._open > 0.5, now, before)  # what a closed box holds, this too

    def begin(self, t: float, x: np.ndarray) -> None:
        """Take the domains as they are; nothing fires."""
        self.above = self._first = np.array(self._g(t, x) > 0.0)

    def reset(self, box: str) -> None:
        """Go back to the domains of the start for the blocks in a box, whose states have done so."""
        inside = np.array([e.path.startswith(f"{box}.") and not e.box for e in self.events])
        self.above = np.where(inside, self._first, self.above)

    def changed(self, t: float, x: np.ndarray) -> np.ndarray:
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
        for b in self._instants(t_old, t_new):
            x = state(b)
            now = self._domains(b, x, self.above)
            fires = self._fires(self.above, now)
            if fires.any():
                times = [self._root(int(i), a, b, state) for i in np.flatnonzero(fires)]
                t = min(times)
                now = self._domains(t, state(t), self.above)
                fired = self._fires(self.above, now)
                self.above = now
                return t, fired
            self.above = now
            a = b
        self.fresh = False
        return None

    def _instants(self, a: float, b: float) -> Iterator[float]:
        n = max(_SAMPLES, math.ceil((b - a) / self._spacing))
        h = (b - a) / n
        if self.fresh:  # an indicator may be back across zero within a small part of the step
            for k in range(_HALVINGS, 0, -1):
                t = a + h * 0.5**k
                if a < t < a + h:
                    yield t
        for i in range(1, n):
            yield a + i * h
        yield b

    def _root(self, i: int, a: float, b: float, state: Callable[[float], np.ndarray]) -> float:
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
            while high - low > 4 * math.ulp(high):
                middle = 0.5 * (low + high)
                low, high = (low, middle) if is_changed(middle) else (middle, high)
            return high
        from scipy.optimize import brentq

        t = float(brentq(z, a, b, xtol=4 * math.ulp(max(abs(a), abs(b))), rtol=1e-15, maxiter=200))
        step = math.ulp(t)
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
        ratios = intervals[1:] / intervals[:-1]
        r = float(np.median(ratios))
        if r < 1.0 and np.all(np.abs(ratios - r) < 0.05 * max(r, 1.0 - r, 0.2)):
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
        """How many rounds of events may follow each other at one instant."""
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
