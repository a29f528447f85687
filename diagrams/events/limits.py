"""Errors of runs that can't go on because of their events: chattering, Zeno behaviour, a rest in contact."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ...blocks.core import SimulationError
from ..flat import FlatEvent

CHATTER, _SPAN = 500, 1e-8  # so many events within so many seconds (relative to 1 + |t|)
_ZENO, _SHRUNK = 8, 1e-6  # intervals that shrink from one to the next, down to this part of the largest one
_RESOLVED = 1e3  # ulps of the time, above which intervals are no matter of rounding
_SLIDES = 10  # events in a row, by which a fixed step knows a sliding mode
_RESTS = 20  # events in a row that lead back into contact; colliding bodies pass an impact on a few times
BRIEF = 1e-4  # of the time between two ticks: rounding alone keeps shorter flights up where each impact takes energy
_BRIEFS = 100  # impacts in a row with shorter flights
_APART = 1e-3  # of the time between two ticks: impacts further apart are not in a row


class EventLimits:
    """Counts of events that have fired, and the errors where they pile up."""

    def __init__(self, events: Sequence[FlatEvent]):
        self.events = events
        self._times = [deque[float](maxlen=_ZENO + 1) for _ in events]
        self._largest = np.zeros(len(events))
        self._instants = 0
        self._recent = np.zeros(CHATTER), np.zeros((CHATTER, len(events)), dtype=np.uint8)
        """Rings of the times in s at which any event has fired last, and which did; ``_instants`` were written."""
        self._side = np.zeros(len(events), dtype=int)
        """The side from which each indicator on the border is held: 1, −1; 0 for none."""
        self._stuck = np.zeros(len(events), dtype=int)
        """Events in a row that led back into contact."""
        self._briefs, self._brief_at = np.zeros(len(events), dtype=int), np.full(len(events), -np.inf)
        """Impacts in a row with brief flights after them, and the time in s of the last one."""
        self.holds = False
        """Whether an indicator on the border is held from a side."""

    # --- a rest in contact -------------------------------------------------------------------------------------------

    def note_contact(self, i: int, side: int) -> None:
        """Note that event ``i``, which has led to that side, has left its indicator in contact."""
        self._side[i], self.holds = side, True

    def note(self, now: np.ndarray) -> None:
        """Note the domains: one that is back on the free side has left contact."""
        if not self.holds:
            return
        free = now * self._side < 0
        if free.any():
            self._side[free] = self._stuck[free] = 0
            self.holds = bool(self._side.any())

    def note_left_border(self, fired: np.ndarray, before: np.ndarray, now: np.ndarray) -> None:
        """Note that events fire: from the border to the side that their jump has held them from, they rest."""
        if self.holds:
            self._stuck += fired & (before == 0) & (now == self._side)

    def rests(self, i: int) -> bool:
        """Return whether event ``i`` has led back into a contact that its jump made."""
        return bool(self._stuck[i])

    def count_brief(self, i: int, t: float, spacing: float) -> None:
        """Note that an impact at t, both in s, is followed by a flight of less than `BRIEF` of the spacing of ticks.

        Raises
        ------
        SimulationError
            If there have been many in a row: the motion has come to rest, but for rounding errors.
        """
        in_a_row = self._brief_at[i] <= t <= self._brief_at[i] + _APART * spacing
        self._briefs[i], self._brief_at[i] = (self._briefs[i] + 1 if in_a_row else 1), t
        if self._briefs[i] >= _BRIEFS:
            raise self.rests_in_contact(t, i, int(self._briefs[i]))

    # --- counts ------------------------------------------------------------------------------------------------------

    def count(self, t: float, fired: np.ndarray, change: Callable[[], tuple[float, np.ndarray]]) -> None:
        """Note that events fired.

        Parameters
        ----------
        change : callable
            Returns a time in s, and by how much the indicators change in it.

        Raises
        ------
        SimulationError
            If they pile up.
        """
        for i in np.flatnonzero(fired):
            if self._stuck[i] >= _RESTS:
                raise self.rests_in_contact(t, int(i), _RESTS)
            times = self._times[i]
            if times:
                self._largest[i] = max(self._largest[i], t - times[-1])
            times.append(t)
            self._look_for_zeno(int(i))
        times_ring, which = self._recent
        times_ring[self._instants % CHATTER], which[self._instants % CHATTER] = t, fired
        self._instants += 1
        if self._instants >= CHATTER and t - self._first_of_recent() < _SPAN * (1.0 + abs(t)):
            raise self.chatters(t, *change())

    def _first_of_recent(self) -> float:
        return float(self._recent[0][self._instants % CHATTER])

    def rests_in_contact(self, t: float, i: int, times: int) -> SimulationError:
        """Return the error of event ``i``, which has led back into contact so many times in a row."""
        event = self.events[i]
        return SimulationError(
            f"the event {event.name!r} rests in contact: its jump leaves its indicator at zero, and the motion leads "
            f"it back beyond at once, {times} times in a row. Nothing in the equations holds it there; going on would "
            "let it pass through. Give the block a state of rest: a discrete state that the jump sets and that holds "
            "the rates, and an event that ends it.",
            block=event.path,
            t=t,
        )

    def slides(self, span: float) -> FlatEvent | None:
        """Return the event of which a few have just fired within so many seconds; None where that is not so."""
        times, n = self._recent[0], self._instants
        if n < _SLIDES or times[(n - 1) % CHATTER] - times[(n - _SLIDES) % CHATTER] > span or self._stuck.any():
            return None
        return self._most_of(_SLIDES)

    def _most_of(self, instants: int) -> FlatEvent:
        rows = [k % CHATTER for k in range(self._instants - instants, self._instants)]
        return self.events[int(np.argmax(self._recent[1][rows].sum(axis=0, dtype=int)))]

    def chatters(self, t: float, h: float, change: np.ndarray) -> SimulationError:
        """Return the error of events that chatter, whose indicators change by so much in a time of h, in s."""
        event = self._most_of(CHATTER)
        size = float(change[list(self.events).index(event)])
        told = f"of {size:.1g} it would switch about every {2.0 * h:.2g} s" if 0.0 < size < np.inf else "it would go on"
        return SimulationError(
            f"the event {event.name!r} chatters: {CHATTER} times events fired within "
            f"{t - self._first_of_recent():.2g} s, so the run would not go on. "
            "What it switches drives the indicator back across zero at once (a sliding mode). Declare a hysteresis; "
            f"with one {told}. In a block of your own that is Event(hysteresis=…), in a Relay its off_point below its "
            "on_point, which takes the place of a Compare, too. Or take a fixed step: solver='rk4'.",
            block=event.path,
            t=t,
        )

    def _look_for_zeno(self, i: int) -> None:
        times = self._times[i]
        if len(times) <= _ZENO or times[-1] - times[-2] > _SHRUNK * self._largest[i]:
            return
        intervals = np.diff(np.array(times))
        if not np.all(intervals > _RESOLVED * np.spacing(times[-1])):
            return
        r = float((intervals[-1] / intervals[0]) ** (1.0 / (len(intervals) - 1)))
        if r < 0.9999 and np.all(intervals[1:] < 1.5 * intervals[:-1]):  # by one ratio, but for what the solver adds
            raise self.shows_zeno(i)

    def shows_zeno(self, i: int) -> SimulationError:
        """Return the error of event ``i``, which fires at intervals that shrink by one ratio."""
        event, times = self.events[i], self._times[i]
        t, intervals = times[-1], np.diff(np.array(times))
        r = float((intervals[-1] / intervals[0]) ** (1.0 / (len(intervals) - 1)))
        limit = t + intervals[-1] * r / (1.0 - r)
        return SimulationError(
            f"the event {event.name!r} shows Zeno behaviour: it fires at intervals that shrink by {r:.4g} each "
            f"time, the last one {intervals[-1]:.2g} s, and would fire infinitely often before t = {limit:.9g} s. "
            "Give the model a state of rest: let its jump stop the motion below a small speed, or end the run "
            "before.",
            block=event.path,
            t=t,
        )

    def endless(self, t: float, fired: np.ndarray, rounds: int) -> SimulationError:
        """Return the error of events that fire each other at one instant for ever."""
        names = ", ".join(f"{self.events[int(i)].path}.{self.events[int(i)].name}" for i in np.flatnonzero(fired))
        event = self.events[int(np.flatnonzero(fired)[0])]
        return SimulationError(
            f"events fire each other without end at one instant: after {rounds} rounds {names} still fires. "
            "Let a jump change what the other's indicator looks at only once, or declare a hysteresis, "
            "Event(hysteresis=…).",
            block=event.path,
            t=t,
        )

    def save(self) -> Any:
        """Return what is needed to go on from here."""
        times = [list(d) for d in self._times]
        rest = self._side.copy(), self._stuck.copy(), self._briefs.copy(), self._brief_at.copy()
        return times, self._largest.copy(), (self._instants, *(ring.copy() for ring in self._recent)), rest

    def restore(self, saved: Any) -> None:
        """Go back to what `save` returned."""
        times, largest, (self._instants, *rings), rest = saved
        self._recent = rings[0].copy(), rings[1].copy()
        self._largest = largest.copy()
        self._side, self._stuck, self._briefs, self._brief_at = (part.copy() for part in rest)
        self.holds = bool(self._side.any())
        self._times = [deque(d, maxlen=_ZENO + 1) for d in times]
