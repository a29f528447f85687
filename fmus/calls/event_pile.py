"""Parts of a step that become so many that the run would not advance: events that pile up, and ends without a step."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

from ...blocks.core import FmuRuntimeError
from .event_mode import EventMode
from .fmi_calls import MOST_ROUNDS
from .loaded_fmu import LoadedFmu
from .step_outcome import ROUNDED

_PILED_PARTS, _PILE_SPAN = 500, 1e-8
"""So many parts of a step within so many seconds (relative to 1 + |t|) are events that pile up."""
_REFUSED_PARTS = 50_000
"""Parts in one step, at the rate of the last ones, above which they are an error."""
_SLOW_PARTS = 1000
"""Parts in one step, at the rate of the last ones, above which the run warns of them."""


class EventPile:
    """Ends of the parts of a step, from t over h, both in s; ``events`` are those of Event Mode, None without it."""

    def __init__(self, fmu: LoadedFmu, events: EventMode | None):
        self._fmu, self._events = fmu, events
        self._instants = deque[float](maxlen=_PILED_PARTS)
        self._t = self._h = 0.0
        self._still = 0  # parts in a row that have ended where they began
        self._has_warned = False

    def begin(self, t: float, h: float) -> None:
        """Begin with the first part of a step."""
        self._t, self._h, self._still = t, h, 0
        self._instants.clear()

    def note_end(self, begun: float, reached: float) -> None:
        """Note where a part has begun and ended; refuse parts that end where they began, one after the other."""
        self._still = self._still + 1 if reached - begun <= ROUNDED * self._h else 0
        if self._still <= MOST_ROUNDS:
            return
        latest = [*self._instants][-MOST_ROUNDS:]
        if latest[-1] > latest[0]:
            self._look(latest, ends=True)
        raise FmuRuntimeError(
            f"its steps returned early at {reached:.9g} s {self._still} times in a row; expected that it continues. "
            "Report it to its makers, or leave early_return out of stepping=.",
            block=self._fmu.setup.label,
            t=self._t,
        )

    def note_instant(self, t: float) -> None:
        """Note a time within the step at which a part has ended."""
        self._instants.append(t)
        if len(self._instants) == _PILED_PARTS:
            self._look(self._instants)

    def _look(self, instants: Sequence[float], *, ends: bool = False) -> None:
        """Warn of events that come so often that the step takes long; refuse those with which it would not end."""
        now, each, h = instants[-1], (instants[-1] - instants[0]) / (len(instants) - 1), self._h
        refused = ends or (h > _REFUSED_PARTS * each and instants[-1] - instants[0] < _PILE_SPAN * (1.0 + abs(now)))
        if not refused and (h < _SLOW_PARTS * each or self._has_warned):
            return
        clocks, next_event = ([], math.inf) if self._events is None else (self._events.clocks, self._events.next_event)
        ticking = [f"its clock {c.variable.name}" for c in clocks if c.next <= now + 2.0 * each]
        own = "a time event" if next_event <= now + 2.0 * each else "an event within a step"
        found = (
            f"found events ({ticking[0] if ticking else own}) every {each:.2g} s, about {h / each:.2g} times in a step"
        )
        advice = "Look up in its documentation which input or parameter sets the time between its events"
        if refused:
            raise FmuRuntimeError(
                f"{found} of {h:g} s, so the run would not advance; expected events that leave it its way. {advice}, "
                "or report it to its makers.",
                block=self._fmu.setup.label,
                t=now,
            )
        self._has_warned = True
        self._fmu.add_note(f"t = {now:.9g} s: {found} of {h:g} s; the run continues slowly. {advice}")
