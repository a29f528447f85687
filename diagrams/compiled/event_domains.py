"""Events in continuous time: the domains of indicators, and the events that changes of them fire.

**Domains.** An indicator z is in one of two domains, z > 0 or z ≤ 0; with a hysteresis δ it leaves the first at z ≤ −δ
and the second at z > δ. A change in the declared direction fires the event.

**Contact.** Zero itself is the border. An indicator that is exactly 0 at the start is in neither domain, and so is one
that the jump of its event leaves in contact by an impact: the jump changes continuous states of the block, and
with them the motion of the indicator, leaves it on 0 or where the event found it, and the rates lead on beyond. The
direction in which it leaves decides: down is falling, up is rising, and that fires the event if it is declared. So a
ball that starts on the floor and moves down, or would fall, hits the floor at the start, one that moves up does not;
sin ωt rises at the start, −sin ωt falls. An indicator that comes to 0 by itself has changed its domain, and continuing
from there fires nothing.

**Rest.** A jump whose motion leads back beyond contact at once, again and again, rests there. That is an error which
names the event: its block needs a state of rest.

**Sliding.** With a fixed step, events that follow each other without end, as those of an ideal relay, wait for the end
of the step from there on, until none fires at the end of one.

The loop in C finds events, lets them fire and keeps the domains: `fmus/runtime/event_search.c` has the search,
`instants.c` what happens at an instant. Here are the domains with which a run begins, what is kept of them, and the
errors.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...blocks.core import SimulationError
from ..flat import FlatDiagram, FlatEvent

LATEST = 9
"""Times of each event that are kept, by which Zeno behaviour is known."""
RECENT = 500
"""Instants at which any event has fired that are kept, by which chattering is known."""


class Domains:
    """The domains of all indicators, and what is known of the events that have fired; C writes all of the arrays.

    ``time_scale`` is the shortest time in s within which a source changes.
    """

    def __init__(self, flat: FlatDiagram, time_scale: float = math.inf):
        self._flat = flat
        n, events = len(flat.events), flat.events
        # Longest time in s between two instants at which indicators are evaluated.
        self.spacing = min(float(flat.base), time_scale)
        # Places of the states of each event's block among the continuous ones.
        self.own = [_continuous_states(flat, e) for e in events]
        # By the names that C has for them: the domain of each indicator (1 above, -1 below, 0 on the border) and at the
        # start; low and high, between which one on the border stays; the slack beyond zero of one that has just crossed
        # it; its size, its rounding errors in a step; largest interval and counts of each event; side, stuck, briefs,
        # brief_at: rest in contact; latest times of each event; fresh: one has fired since the last step without one;
        # recent and recent_fired: rings of the last instants at which any has fired, and which did.
        names = ["domain", "start", "low", "high", "slack", "size", "rounding", "largest", "counts"]
        names += ["side", "stuck", "briefs", "brief_at"]
        self.parts = {name: np.zeros(n) for name in names}
        self.parts |= {"latest": np.zeros((n, LATEST)), "fresh": np.zeros(1), "recent": np.zeros(RECENT)}
        self.parts["recent_fired"] = np.zeros((RECENT, n), dtype=np.uint8)
        self.parts["brief_at"][:] = -np.inf
        self._hysteresis = np.array([e.hysteresis for e in events])
        self._gates = np.array([e.subsystem for e in events], dtype=bool)
        # Sliding: events of a fixed step wait for its end, and one has fired there.
        self.fired_times, self.sliding = 0, (False, False)
        self._reported = set[int]()
        self.limits = EventLimits(events, self.parts)

    def begin(self, z: np.ndarray) -> None:
        """Take the domains at the values z of the indicators where a run begins; nothing fires."""
        parts = self.parts
        on_border = (z == 0.0) & ~self._gates
        parts["domain"][:] = np.where(z > 0.0, 1, np.where(on_border, 0, -1))
        parts["start"][:], parts["slack"][:] = parts["domain"], 0.0
        parts["low"][:], parts["high"][:] = -self._hysteresis, self._hysteresis

    def report_sliding(self, t: float, event: int) -> tuple[str, ...]:
        """Return what is to be reported of an event that waits for the ends of steps from t on, in s; once for each."""
        if event in self._reported:
            return ()
        self._reported.add(event)
        of = self._flat.events[event]
        message = (
            f"t = {t:.6g} s: {of.path}.{of.name} switches back and forth without end (a sliding mode); from here on it "
            "is looked at once a step. A hysteresis would make it an event again."
        )
        return (message,)

    def begin_again(self) -> None:
        """Report events again that were reported in a run before."""
        self._reported.clear()

    def save(self) -> dict[str, Any]:
        """Return what is needed to continue from here."""
        parts = {name: part.copy() for name, part in self.parts.items()}
        return {"parts": parts, "fired_times": self.fired_times, "sliding": self.sliding}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Go back to what `save` returned."""
        for name, part in self.parts.items():
            part[:] = saved["parts"][name]
        self.fired_times, self.sliding = saved["fired_times"], saved["sliding"]


def _continuous_states(flat: FlatDiagram, event: FlatEvent) -> np.ndarray:
    """Return where the states of an event's block are among the continuous ones."""
    if event.subsystem or event.path not in flat.states.slices:
        return np.zeros(0, dtype=int)
    where = flat.states.slices[event.path]
    return np.flatnonzero((flat.continuous >= where.start) & (flat.continuous < where.stop))


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
