"""Event Mode of an FMU in co-simulation (FMI 3.0, 2.3.5 and 4.2.1): discrete inputs, clocks, the event iteration.

Events may be so many parts of a step that the run would not advance: they pile up.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...blocks.core import FmuRuntimeError
from ..archive import OtherVariable
from .event_calls import check_next_time
from .fmi_calls import MOST_ROUNDS
from .loaded_fmu import LoadedFmu
from .step_outcome import ROUNDED, StepOutcome
from .transfer import Transfer, UnfitError, WatchedInputs

_CHANGED = 2
"""Qualifier of an interval that the FMU has set again (fmi3IntervalChanged)."""


@dataclass
class InputClock:
    """Input clock that ticks at times known ahead; infinite ones never come."""

    variable: OtherVariable
    interval: float = math.inf
    next: float = math.inf
    count: int = 0
    origin: float = 0.0

    def start(self, t: float, interval: float, shift: float) -> None:
        """Let it tick at t + shift, and then every interval, in s."""
        self.interval, self.origin, self.count = interval, t + shift, 0
        self.next = self.origin

    def tick(self) -> None:
        """Continue to the next tick."""
        if self.variable.is_periodic:
            self.count += 1
            self.next = self.origin + self.count * self.interval
        else:
            self.next = math.inf  # until the FMU says it again

    def go_to(self, t: float) -> None:
        """Go to the first tick from a time in s on."""
        if self.variable.is_periodic and math.isfinite(self.interval):
            ahead = (t - self.origin) / self.interval
            self.count = max(0, math.ceil(ahead - ROUNDED * max(1.0, ahead)))
            self.next = self.origin + self.count * self.interval


@dataclass(frozen=True)
class EventMemory:
    """Events besides the FMU's own state: the next ones, and the values that discrete inputs had."""

    next_event: float
    is_fresh: bool
    clocks: tuple[tuple[float, float, int, float], ...]
    values: tuple[np.ndarray, ...]


class EventMode:
    """Events of an instance: before a step, within it, and at its end. ``vector`` are all inputs, shared."""

    def __init__(self, fmu: LoadedFmu, outcome: StepOutcome, vector: np.ndarray):
        self.fmu, self.fmi, self.outcome, inputs = fmu, fmu.fmi, outcome, fmu.inputs
        self.discrete = [port for port, v in inputs.items() if v.variability != "continuous"]
        ours = {v.name: v for v in fmu.description.other.values() if v.type_is_clock and v.causality == "input"}
        by_clocks: dict[tuple[str, ...], list[str]] = {}
        for port in self.discrete:
            by_clocks.setdefault(tuple(name for name in inputs[port].clocks if name in ours), []).append(port)
        self._jumping = WatchedInputs(self.fmi, inputs, vector, by_clocks.pop((), []))
        continuous = [port for port in inputs if port not in self.discrete]
        self._sampled = Transfer(self.fmi, "Set", inputs, vector, continuous) if ours and continuous else None
        """Continuous inputs, which a tick may sample."""
        self._clocked = [(names, WatchedInputs(self.fmi, inputs, vector, ports)) for names, ports in by_clocks.items()]
        self._triggered = {name: v for name, v in ours.items() if v.interval_variability == "triggered"}
        self.clocks = [InputClock(v) for v in ours.values() if v.interval_variability != "triggered"]
        self.next_event = math.inf
        self._is_fresh = True  # discrete inputs have not been set since the start

    @property
    def watched(self) -> list[WatchedInputs]:
        """Inputs at whose changes events are."""
        return [self._jumping, *(part for _, part in self._clocked)]

    @property
    def next_instant(self) -> float:
        """Time in s of the next event that is known ahead; infinite without one."""
        return min([self.next_event, *(clock.next for clock in self.clocks)])

    # ---- the start, and saved states ----

    def begin(self, t: float) -> None:
        """Settle the events at the start, where the FMU is in Event Mode after its initialization."""
        self._is_fresh, self.next_event = True, math.inf
        for clock in self.clocks:
            clock.next = math.inf  # that of an earlier run, if any
            if clock.variable.is_periodic and clock.variable.interval is not None:
                clock.start(t, clock.variable.interval, clock.variable.shift)
        self._read_intervals(t, [c for c in self.clocks if not c.variable.is_periodic or c.variable.interval is None])
        self._activate(t, [clock for clock in self.clocks if clock.next <= t], set())
        self._settle(t)

    def memory(self) -> EventMemory:
        """Return what is known besides the FMU's own state."""
        clocks = tuple((clock.interval, clock.next, clock.count, clock.origin) for clock in self.clocks)
        return EventMemory(self.next_event, self._is_fresh, clocks, tuple(part.values.copy() for part in self.watched))

    def return_to(self, t: float, memory: EventMemory | None) -> None:
        """Continue from a restored state at a time in s; without a memory Event Mode announces events again."""
        if memory is None:
            self._is_fresh, self.next_event = True, math.inf
            for clock in self.clocks:
                clock.go_to(t)
            return
        self._is_fresh, self.next_event = memory.is_fresh, memory.next_event
        for part, values in zip(self.watched, memory.values, strict=True):
            part.values[:] = values
        for clock, kept in zip(self.clocks, memory.clocks, strict=True):
            clock.interval, clock.next, clock.count, clock.origin = kept

    # ---- events ----

    def act_before(self, t: float, h: float) -> None:
        """Go through Event Mode before a step of h from t, both in s, where anything is due or an input has jumped."""
        changed, due = self._jumping.take(), self._due(t, h)
        waiting = {name for names, part in self._clocked if part.differs for name in names if name in self._triggered}
        if changed or self._is_fresh or waiting or due or self.next_event <= t + ROUNDED * h:
            self._enter()
            self._set(self._jumping.transfer, t)
            if self._sampled is not None:
                self._set(self._sampled, t)
            self._activate(t, due, waiting)
            self._settle(t)
            self.outcome.check_end(t, h, t)
        self._is_fresh = False

    def act_within(self, t: float, end: float, h: float, *, asked: bool) -> bool:
        """Go through Event Mode at t in a step of h up to an end, where the FMU asks for it or anything is due.

        Return whether it was gone through. Clocks that tick at the end wait for the next step's inputs.
        """
        due = self._due(t, h) if t < end else []
        acts = asked or bool(due) or self.next_event <= t + ROUNDED * h
        if acts:
            self._enter()
            self._activate(t, due, set())
            self._settle(t)
        return acts

    def _due(self, t: float, h: float) -> list[InputClock]:
        return [clock for clock in self.clocks if clock.next <= t + ROUNDED * h]

    def _enter(self) -> None:
        self.fmu.call("entering Event Mode", self.fmi.enter_event_mode)

    def _set(self, inputs: Transfer, t: float) -> None:
        """Set inputs at a time in s."""
        self.fmu.check_limits(inputs, t)
        try:
            status = inputs.set()
        except UnfitError as error:
            raise self.fmu.refuse(error, t) from None
        self.fmu.judge("setting the inputs", status, t)

    def _activate(self, t: float, due: list[InputClock], triggered: set[str]) -> None:
        """Let clocks tick, and set the inputs that may be set at these ticks alone."""
        ticking = {clock.variable.name: clock.variable for clock in due}
        ticking |= {name: self._triggered[name] for name in sorted(triggered)}
        if ticking:
            references = [clock.reference for clock in ticking.values()]
            self.fmu.call("activating its clocks", self.fmi.activate_clocks, references)
        for clock in due:
            clock.tick()
        for names, part in self._clocked:
            if not ticking.keys().isdisjoint(names):
                part.take()
                self._set(part.transfer, t)

    def _settle(self, t: float) -> None:
        """Update the discrete states until nothing changes, and go back to Step Mode."""
        fmu = self.fmu
        found = fmu.call("updating its discrete states", self.fmi.iterate_events)
        if found.terminate:  # it stays in Event Mode, in which outputs can be read
            self.outcome.take_end(t, 0.0, t)
            return
        if found.again:
            raise FmuRuntimeError(
                f"the events don't settle in {MOST_ROUNDS} rounds (discreteStatesNeedUpdate); expected that they end. "
                "Report it to its makers.",
                block=fmu.setup.label,
                t=t,
            )
        self.next_event = check_next_time(fmu.setup.label, found.next_time, t)
        self._read_intervals(t, [c for c in self.clocks if not c.variable.is_periodic])
        fmu.call("entering Step Mode", self.fmi.enter_step_mode)

    def _read_intervals(self, t: float, clocks: list[InputClock]) -> None:
        """Ask the FMU for the intervals that its description does not state."""
        if not clocks:
            return
        references = [clock.variable.reference for clock in clocks]
        found = self.fmu.call("reading the intervals of its clocks", self.fmi.clock_intervals, references)
        for clock, (interval, qualifier) in zip(clocks, found, strict=True):
            if clock.variable.is_periodic:
                clock.start(t, interval, clock.variable.shift)
            elif qualifier == _CHANGED:
                clock.start(t, math.inf, interval)


# --- events that pile up ----------------------------------------------------------------------------------------------


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
