"""Co-simulation steps with events: Event Mode, clocks, early return, discarded steps, slopes of inputs.

A plain step sets the inputs, steps, and gets the outputs. These steps do more, and are taken where an FMU or its
options need that.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np

from ...blocks.core import FmuRuntimeError
from ..archive import FmuVariable
from .fmi_calls import DISCARD, MOST_ROUNDS, WARNING, StepCall
from .fmu_block import check_next_time
from .saved_state import Clock, FmuState, StepMemory
from .step_options import StepTime, add_step, allows_early_return, uses_event_mode
from .stepped_instance import SavedInstance
from .transfer import PartTransfer, Transfer, UnfitError

_ROUNDED = 1e-9
"""Part of a step within which two times are one."""
R = TypeVar("R")
_MANY, _SPAN = 500, 1e-8
"""So many parts of a step within so many seconds (relative to 1 + |t|) are events that pile up."""
_MOST, _SLOW = 50_000, 1000
"""Parts of a step, at the rate of the last ones, that are an error, and those that are told."""
_CHANGED = 2
"""Qualifier of an interval that the FMU has set anew (fmi3IntervalChanged)."""


class CarefulSteps:
    """Steps of an instance with events; its ``step`` has the face of a plain one.

    Parameters
    ----------
    instance : SavedInstance
        The instance.
    inputs, outputs : mapping of str to FmuVariable
        Variables of the ports.
    vector : ndarray
        Values of all inputs, shared with the run.
    outs : Transfer
        Getting of the outputs.
    call : StepCall
        The FMU's step.
    """

    def __init__(
        self,
        instance: SavedInstance,
        inputs: Mapping[str, FmuVariable],
        vector: np.ndarray,
        outs: Transfer,
        call: StepCall,
    ):
        self.instance, self.outs, self.call = instance, outs, call
        self.about, self.options = instance.description, instance.block.stepping
        self.fmi = instance.fmi
        self.old = not self.about.fmi.startswith("3")
        self.has_events = uses_event_mode(self.about, self.options)
        jumping = [port for port, v in inputs.items() if self.has_events and v.variability != "continuous"]
        self.smooth = PartTransfer(instance.fmi, inputs, vector, [port for port in inputs if port not in jumping])
        ours = {v.name: v for v in self.about.other.values() if v.type_is_clock and v.causality == "input"}
        by_clocks: dict[tuple[str, ...], list[str]] = {}
        for port in jumping:
            by_clocks.setdefault(tuple(name for name in inputs[port].clocks if name in ours), []).append(port)
        self.jumping = PartTransfer(instance.fmi, inputs, vector, by_clocks.pop((), []))
        self.clocked = [
            (names, PartTransfer(instance.fmi, inputs, vector, ports)) for names, ports in by_clocks.items()
        ]
        self.triggered = {name: v for name, v in ours.items() if v.interval_variability == "triggered"}
        self.clocks = [
            Clock(v)
            for v in self.about.other.values()
            if v.type_is_clock and v.causality == "input" and v.interval_variability != "triggered"
        ]
        self.next_event = math.inf
        ports = {p: v for p, v in self.smooth.ports.items() if v.type == "Float64" and (v.intermediate or self.old)}
        told = ports if self.options.input_derivatives else {}
        self.sloped = np.concatenate([np.zeros(0, dtype=int), *(np.r_[self.smooth.places[port]] for port in told)])
        """Places of the inputs whose slopes are told, among those of `smooth`."""
        self.sloped_references = [r for v in told.values() for r in v.references]
        self.last = np.full(1 + self.sloped.size, math.nan)
        """Time in s and values of these inputs at the step before; NaN without one."""
        self._taken: tuple[int, FmuState | None] | None = None  # status of a step that C has taken, state before it
        self.added = np.full(1, math.nan)
        """Time in s that steps have added up to; NaN before the first one. With `StepTime.ADDED` steps begin there."""
        self._has_told = False
        self._fresh = True  # discrete inputs have not been set since the start

    # ---- the start ----

    def begin(self, t: float) -> None:
        """Settle the events at the start, where the FMU is in Event Mode after its initialization.

        It is called only if Event Mode is used.
        """
        self.last[:], self.added[:], self._fresh = math.nan, math.nan, True
        self.next_event = math.inf
        for clock in self.clocks:
            if clock.variable.is_periodic and clock.variable.interval is not None:
                clock.start(t, clock.variable.interval, clock.variable.shift)
        self._read_intervals(t, [c for c in self.clocks if not c.variable.is_periodic or c.variable.interval is None])
        self._activate(t, [clock for clock in self.clocks if clock.next <= t], set())
        self._settle(t)

    @property
    def next_instant(self) -> float:
        """Time in s of the next event that is known ahead; infinite without one."""
        return min([self.next_event, *(clock.next for clock in self.clocks)])

    def memory(self) -> StepMemory:
        """Return what the steps keep beside the FMU's own state."""
        clocks = tuple((clock.interval, clock.next, clock.count, clock.origin) for clock in self.clocks)
        clocked = tuple(part.values.copy() for _, part in self.clocked)
        jumping = self.jumping.values.copy()
        return StepMemory(
            self.next_event, self.last.copy(), float(self.added[0]), self._fresh, clocks, clocked, jumping
        )

    def return_to(self, t: float, memory: StepMemory | None) -> None:
        """Go on from a restored state at a time in s; without a memory Event Mode tells the next events anew."""
        if memory is not None:
            self.next_event, self.last[:] = memory.next_event, memory.last
            self.added[:], self._fresh = memory.added, memory.fresh
            self.jumping.values[:] = memory.jumping
            for (_, part), values in zip(self.clocked, memory.clocked, strict=True):
                part.values[:] = values
            for clock, kept in zip(self.clocks, memory.clocks, strict=True):
                clock.interval, clock.next, clock.count, clock.origin = kept
            return
        self.last[:], self.added[:], self._fresh, self.next_event = math.nan, math.nan, True, math.inf
        for clock in self.clocks:
            if clock.variable.is_periodic and math.isfinite(clock.interval):
                ahead = (t - clock.origin) / clock.interval
                clock.count = max(0, math.ceil(ahead - _ROUNDED * max(1.0, ahead)))
                clock.next = clock.origin + clock.count * clock.interval

    # ---- a step ----

    def step(self, t: float, h: float) -> None:
        """Set the inputs, go from t to t + h (both in s), and get the outputs."""
        instance = self.instance
        start = add_step(self.added, t, h) if self.options.time is StepTime.ADDED else t
        changed = self.jumping.take()
        due = [c for c in self.clocks if c.next <= start + _ROUNDED * h]
        waiting = {name for names, part in self.clocked if part.differs for name in names if name in self.triggered}
        soon = waiting or due or self.next_event <= start + _ROUNDED * h
        if self.has_events and (changed or self._fresh or soon):
            self._handle_events(start, due, waiting, set_inputs=True)
            instance.check_end(start, h, start)
        self._fresh = False
        self.smooth.take()
        self._set(self.smooth, start)
        if self.options.input_derivatives:
            self._tell_slopes(start)
        self._finish(start, h)

    def go_on(self, t: float, h: float, status: int, state: FmuState | None) -> None:
        """Go on with a step from t to t + h (both in s) that C has taken with its inputs, with a status.

        ``state`` is that before it, of an FMU whose steps can be taken back.
        """
        self.smooth.take()
        self._taken = status, state
        self._finish(t, h)

    def _finish(self, start: float, h: float) -> None:
        """Step from start by h, both in s, once the inputs are set, and get the outputs."""
        instance = self.instance
        self._go(start, h)
        instance.set_span(start, h)
        if (status := self.fmi.intermediate_status) > WARNING:
            self.fmi.intermediate_status = 0
            raise instance.report(f"setting its inputs within the step by {h:g} s", status, start)
        self._get(start + h)

    def _go(self, t: float, h: float) -> None:
        """Step from t by h, in parts where events lie between or the FMU ends a step early."""
        end, now, still, instants = t + h, t, 0, deque[float](maxlen=_MANY)
        while end - now > _ROUNDED * h:
            target = min(end, self.next_instant)
            if not self.about.variable_step:
                target = self._check_even(now, end, target, h)
            target = end if end - target < _ROUNDED * h else target
            reached, event = self._take(now, (end if target == end else target) - now)
            still = still + 1 if reached - now <= _ROUNDED * h else 0
            if still > MOST_ROUNDS:
                latest = [*instants][-MOST_ROUNDS:]
                if latest[-1] > latest[0]:
                    self._look_for_pile(latest, h, ends=True)
                raise FmuRuntimeError(
                    f"its steps returned early at {reached:.9g} s {still} times in a row; expected that it goes on. "
                    "Report it to its makers, or leave early_return out of stepping=.",
                    block=self.instance.block.label,
                    t=t,
                )
            now = end if end - reached <= _ROUNDED * h else reached
            if self._check_end(t, h, now):
                return
            instants.append(now)
            if len(instants) == _MANY:
                self._look_for_pile(instants, h)
            due = [c for c in self.clocks if c.next <= now + _ROUNDED * h and now < end]
            if self.has_events and (event or due or self.next_event <= now + _ROUNDED * h):
                self._handle_events(now, due, set(), set_inputs=False)
                if self._check_end(t, h, now):
                    return

    def _look_for_pile(self, instants: Sequence[float], h: float, *, ends: bool = False) -> None:
        """Tell of events that come so often that a step of h takes long; refuse those with which it would not end."""
        now, each = instants[-1], (instants[-1] - instants[0]) / (len(instants) - 1)
        refused = ends or (h > _MOST * each and instants[-1] - instants[0] < _SPAN * (1.0 + abs(now)))
        if not refused and (h < _SLOW * each or self._has_told):
            return
        clocks = [f"its clock {c.variable.name}" for c in self.clocks if c.next <= now + 2.0 * each]
        own = "a time event" if self.next_event <= now + 2.0 * each else "an event within a step"
        found = (
            f"found events ({clocks[0] if clocks else own}) every {each:.2g} s, about {h / each:.2g} times in a step"
        )
        advice = "Look up in its documentation which input or parameter sets the time between its events"
        if refused:
            raise FmuRuntimeError(
                f"{found} of {h:g} s, so the run would not go on; expected events that leave it its way. {advice}, or "
                "report it to its makers.",
                block=self.instance.block.label,
                t=now,
            )
        self._has_told = True
        self.instance.add_note(f"t = {now:.9g} s: {found} of {h:g} s; the run goes on slowly. {advice}")

    def _check_end(self, t: float, h: float, now: float) -> bool:
        """Return whether the FMU asks to end the simulation now; raise its error before the end of the step."""
        self.instance.check_end(t, h, now)
        return self.instance.ends_run

    def _check_even(self, now: float, end: float, target: float, h: float) -> float:
        """Return the end of the step of an FMU that takes steps of one length only; refuse clocks within it."""
        for clock in self.clocks:
            if now + _ROUNDED * h < clock.next < end - _ROUNDED * h:
                raise FmuRuntimeError(
                    f"its clock {clock.variable.name} ticks at {clock.next:.9g} s, between two communication points, "
                    "and it takes steps of one length only (canHandleVariableCommunicationStepSize is false); expected "
                    f"steps that end there. Run with step={clock.interval:.9g}.",
                    block=self.instance.block.label,
                    t=now,
                )
        return end

    def _take(self, t: float, h: float) -> tuple[float, bool]:
        """Step once; return the time that was reached, and whether the FMU asks for Event Mode."""
        instance, call = self.instance, self.call
        taken, self._taken = self._taken, None
        if taken is None:
            state = instance.save() if self.options.rollback else None
            instance.set_span(t, h)
            status = call.function(*call.arguments)
        else:
            status, state = taken
        if status > 1:
            if state is None or self.fmi.end_step(status)[0] != DISCARD or not self._redo(state, t, h):
                instance.end_step(status, t, h)
            return t + h, False
        if status:
            instance.judge("a step", status, t)
        event, ends, early, _ = call.flags
        if early and not ends and allows_early_return(self.about, self.options):
            return min(max(call.reached.value, t), t + h), bool(event)
        instance.check_flags(call, t, h)
        return t + h, bool(event)

    def _redo(self, state: FmuState, t: float, h: float) -> bool:
        """Take a discarded step again from its start, in smaller ones; return whether that has worked."""
        instance, call, end = self.instance, self.call, t + h
        now, part, count, status, smallest = t, h, 0, DISCARD, h * 0.5**self.options.retries
        while end - now > _ROUNDED * smallest:
            if status == DISCARD:
                known = self.fmi.time_after_discard(now, part)
                instance.go_back(state)
                part = known - now if known is not None and smallest < known - now < part else 0.5 * part
                if part < smallest * (1.0 - _ROUNDED):
                    return False
            else:
                state, part = instance.save(), end - now
            instance.set_span(now, part)
            status, ends = self.fmi.end_step(call.function(*call.arguments))
            if ends:
                return False
            if status <= WARNING:
                if status:
                    instance.judge("a step", status, now)
                now, count = now + part, count + 1
                if call.any_flag.value:
                    instance.check_flags(call, now - part, part)
                    instance.check_end(t, h, now)
            elif status != DISCARD:
                return False
        instance.set_span(t, h)
        instance.note_retry(t, h, count)
        return True

    # ---- values ----

    def _set(self, part: PartTransfer, t: float) -> None:
        if not part.index.size:
            return
        self.instance.check_limits(part.transfer, t)
        try:
            status = part.transfer.set()
        except UnfitError as error:
            raise self.instance.refuse_input(error, t) from None
        if status:
            self.instance.judge("setting the inputs", status, t)

    def _get(self, t: float) -> None:
        try:
            status = self.outs.get()
        except UnfitError as error:
            raise self.instance.refuse_output(error, t) from None
        if status:
            self.instance.judge("reading the outputs", status, t)

    def _tell_slopes(self, t: float) -> None:
        """Tell the slopes of the real inputs by their differences from the step before (FMI 2.0, 4.2.1)."""
        now = self.smooth.values[self.sloped]
        slopes = (now - self.last[1:]) / (t - self.last[0]) if t > self.last[0] else np.zeros(now.size)
        if now.size:
            call = (self.fmi.set_input_slopes, t, self.sloped_references, now.tolist(), slopes.tolist())
            self.instance.call("telling the slopes of its inputs", *call)
        self.last[0], self.last[1:] = t, now

    # ---- events ----

    def _handle_events(self, t: float, due: list[Clock], triggered: set[str], *, set_inputs: bool) -> None:
        """Enter Event Mode, let clocks tick, and settle (FMI 3.0, 2.3.5 and 4.2.1)."""
        instance = self.instance
        instance.call("entering Event Mode", self.fmi.enter_event_mode)
        if set_inputs:
            self._set(self.jumping, t)
        self._activate(t, due, triggered)
        self._settle(t)

    def _activate(self, t: float, due: list[Clock], triggered: set[str]) -> None:
        """Let clocks tick, and set the inputs that may be set at these ticks alone."""
        ticking = {clock.variable.name: clock.variable for clock in due}
        ticking |= {name: self.triggered[name] for name in sorted(triggered)}
        if ticking:
            references = [clock.reference for clock in ticking.values()]
            self.instance.call("activating its clocks", self.fmi.activate_clocks, references)
        for clock in due:
            clock.tick()
        for names, part in self.clocked:
            if not ticking.keys().isdisjoint(names):
                part.take()
                self._set(part, t)

    def _settle(self, t: float) -> None:
        """Update the discrete states until nothing changes, and go back to Step Mode."""
        instance = self.instance
        for _ in range(MOST_ROUNDS):
            found = instance.call("updating its discrete states", self.fmi.update_events)
            if found.terminate:  # it stays in Event Mode, in which outputs can be read
                instance.take_end(t, 0.0, t)
                return
            if not found.again:
                self.next_event = check_next_time(instance.block, found.next_time, t)
                break
        else:
            raise FmuRuntimeError(
                f"the events don't settle in {MOST_ROUNDS} rounds (discreteStatesNeedUpdate); expected that they end. "
                "Report it to its makers.",
                block=instance.block.label,
                t=t,
            )
        self._read_intervals(t, [c for c in self.clocks if not c.variable.is_periodic])
        instance.call("entering Step Mode", self.fmi.enter_step_mode)

    def _read_intervals(self, t: float, clocks: list[Clock]) -> None:
        """Ask the FMU for the intervals that its description does not state."""
        if not clocks:
            return
        references = [clock.variable.reference for clock in clocks]
        found = self.instance.call("reading the intervals of its clocks", self.fmi.clock_intervals, references)
        for clock, (interval, qualifier) in zip(clocks, found, strict=True):
            if clock.variable.is_periodic:
                clock.start(t, interval, clock.variable.shift)
            elif qualifier == _CHANGED:
                clock.start(t, math.inf, interval)
