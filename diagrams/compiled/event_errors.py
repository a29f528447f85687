"""Errors of runs that can't continue because of their events: chattering, Zeno behaviour, a rest in contact."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ...blocks.core import SimulationError
from ..flat import FlatEvent

RECENT = 500
"""Instants at which any event has fired that are kept, by which chattering is known."""


class EventLimits:
    """The errors of events that pile up; ``parts`` are those of `Domains`."""

    def __init__(self, events: Sequence[FlatEvent], parts: Mapping[str, np.ndarray]):
        self.events, self._parts = events, parts

    def rests_in_contact(self, t: float, i: int, times: int) -> SimulationError:
        """Return the error of event ``i``, which has led back into contact so many times in a row."""
        event = self.events[i]
        return SimulationError(
            f"the event {event.name!r} rests in contact: its jump leaves its indicator at zero, and the motion leads "
            f"it back beyond at once, {times} times in a row. Nothing in the equations holds it there; continuing "
            "would let it pass through. Give the block a state of rest: a discrete state that the jump sets and that "
            "holds the rates, and an event that ends it.",
            block=event.path,
            t=t,
        )

    def chatters(self, t: float, i: int, h: float, change: np.ndarray) -> SimulationError:
        """Return the error of event ``i``, which chatters; the indicators change by so much in a time of h, in s."""
        event, size, first = self.events[i], float(change[i]), float(self._parts["recent"].min())
        slower = f"of {size:.1g} it would switch about every {2.0 * h:.2g} s" if 0.0 < size < np.inf else "it would run"
        return SimulationError(
            f"the event {event.name!r} chatters: {RECENT} times events fired within "
            f"{t - first:.2g} s, so the run would not advance. "
            "What it switches drives the indicator back across zero at once (a sliding mode). Declare a hysteresis; "
            f"with one {slower}. In your own block that is Event(hysteresis=…), in a Relay its off_point below its "
            "on_point, which takes the place of a Compare, too. Or take a fixed step: solver='rk4'.",
            block=event.path,
            t=t,
        )

    def shows_zeno(self, i: int) -> SimulationError:
        """Return the error of event ``i``, which fires at intervals that shrink by one ratio."""
        event, times = self.events[i], self._parts["latest"][i]
        t, intervals = float(times[-1]), np.diff(times)
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
