"""A communication step of an FMU, `doStep`: its inputs are set, time advances, its outputs are read.

`StepParts` says what else belongs to it. It is the same step in this process and in another one, for Python and for the
loops in C, which take it by its addresses (`InstanceStep.native`, `InstanceStep.remote`).
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np

from ...blocks.core import FmuRuntimeError
from .bound_calls import BoundCalls, Call
from .event_mode import EventMemory, EventMode, EventPile
from .fmi_calls import DISCARD, WARNING
from .input_slopes import InputSlopes
from .loaded_fmu import LoadedFmu
from .native_calls import NativeStep, QuietStep, RemoteStep, address_of, share, transfer_at
from .saved_state import FmuState, SavedStates
from .step_options import StepParts, parts_of_step
from .step_outcome import NEAR, ROUNDED, StepOutcome
from .text_values import watch_texts
from .transfer import Transfer, UnfitError, WatchedInputs

_BY_PYTHON = StepParts.EVENTS | StepParts.EARLY_RETURN | StepParts.SLOPES | StepParts.ROLLBACK
"""Parts with which a loop in C takes those steps alone that turn out to be nothing but calls."""


@dataclass(frozen=True)
class StepMemory:
    """Memory of the steps besides the FMU's own state, for a return to it."""

    added: float
    sloped: np.ndarray
    events: EventMemory | None


class InstanceStep:
    """Steps of an instance, with all that belongs to them by its options; u and y are shared with the run.

    All calls of a step are bound once. A library in this process makes them one after the other; another process makes
    them, and those that read the outputs, in one round trip.
    """

    def __init__(self, fmu: LoadedFmu, states: SavedStates, outcome: StepOutcome, u: np.ndarray, y: np.ndarray):
        self.fmu, self.states, self.outcome = fmu, states, outcome
        self.fmi, fmi, inputs = fmu.fmi, fmu.fmi, fmu.inputs
        self.options, self._texts, outcome.vector = fmu.setup.stepping, fmu.record, u
        self.parts = parts_of_step(fmu.description, self.options)
        self.call = fmi.step_call(outcome.now, outcome.width, states.final)
        self._guard = fmu.host if fmi.in_process and not fmu.is_built_here else nullcontext()
        self._t, self._h = 0.0, 0.0
        self._all_inputs = Transfer(fmi, "Set", inputs, u)
        self._outs = Transfer(fmi, "Get", fmu.setup.output_variables, y)
        self.events = EventMode(fmu, outcome, u) if StepParts.EVENTS in self.parts else None
        discrete = [] if self.events is None else self.events.discrete
        held = [port for port in inputs if port not in discrete]
        self._ins = Transfer(fmi, "Set", inputs, u, held) if discrete else self._all_inputs
        self._slopes = InputSlopes(fmu, held, u) if StepParts.SLOPES in self.parts else None
        self._added = np.full(1, math.nan)
        """Time in s that steps have added up to, at which the next one begins; NaN before the first one."""
        self._watch = watch_texts(fmi, fmu.record.variables.values())
        self._bind()
        self._reads = fmi.bind(self._outs.calls)
        self._exchange = fmi.bind([*self._all_inputs.calls, *self._outs.calls])
        self._is_read = False
        """Whether the calls of a step have read the outputs as they are at its end."""
        self._pile = EventPile(fmu, self.events)
        self._until = np.full(1, -math.inf if self.parts & _BY_PYTHON else math.inf)
        """Time in s before whose neighbourhood C takes steps."""
        self._taken = np.zeros(sum(part.index.size for part in self._watched))
        """Values of inputs at whose changes events are, after the last step of Python's."""

    @property
    def _watched(self) -> list[WatchedInputs]:
        return [] if self.events is None else self.events.watched

    def _bind(self) -> None:
        """Bind the calls of a step, up to its end; in another process those behind it, too."""
        fmi, call = self.fmi, self.call
        self._handle = fmi.variable(ctypes.c_void_p)
        self._kept: FmuState | None = None
        """State before the last step, as its calls have saved it."""
        self._before: FmuState | None = None
        """State before the present part of a step, for its rollback."""
        stages: list[tuple[str, Sequence[Call]]] = [("setting the inputs", self._ins.calls)]
        if self._slopes is not None:
            stages.append(("telling the slopes of its inputs", self._slopes.calls))
        if StepParts.ROLLBACK in self.parts:
            self.states.final.value = False
            stages.append(("saving its state", [fmi.save_call(self._handle)]))
        self._place = sum(len(calls) for _, calls in stages)
        """Place of the step among the calls."""
        stages.append(("a step", [(call.function, call.arguments)]))
        if not fmi.in_process:
            stages.append(("reading the outputs", self._outs.calls))
            stages.append(("reading its texts", [] if self._watch is None else self._watch.calls))
        self._actions = [action for action, calls in stages for _ in calls]
        self._calls = fmi.bind([each for _, calls in stages for each in calls])

    def function(self) -> Callable[[float, float], None]:
        """Return `step`; for plain steps of whole vectors of Float64 a function that looks up little."""
        call, run, outcome = self.call, self._calls.run, self.outcome
        is_plain = self._ins.is_whole and self._outs.is_whole and not self._ins.has_limits
        if not is_plain or self.parts or self._texts.variables or not isinstance(self._guard, nullcontext):
            return self.step
        now, width, any_flag, reached = outcome.now, outcome.width, call.any_flag, call.reached
        filled, spread = self._ins.views, self._outs.views  # (from, to) each, in the sense of setting
        read = self._reads.run if self.fmi.in_process else None

        def step(t: float, h: float) -> None:
            for here, there in filled:
                there[:] = here
            now.value, width.value = t, h
            outcome.is_stepping = True
            status = run()
            if status or any_flag.value or abs(reached.value - t - h) > h * NEAR:
                self._t, self._h = t, h
                self._end(status)
                return
            outcome.is_stepping = False
            if read is not None and (status := read()):
                self._judge_reading(self._reads, status, t if status > WARNING else t + h)
            for here, there in spread:
                here[:] = there

        return step

    # ---- a step ----

    def step(self, t: float, h: float) -> None:
        """Set the inputs, take a step from a time over a length, both in s, and get the outputs."""
        self.start(t, h)
        self.finish()

    def start(self, t: float, h: float) -> None:
        """Set the inputs, and begin a step; one in another process continues by itself until `finish`."""
        if StepParts.ADDED_TIME in self.parts:
            t = t if math.isnan(self._added[0]) else float(self._added[0])
            self._added[0] = t + h
        self._t, self._h = t, h
        if self.events is not None:
            with self._guard:
                self.events.act_before(t, h)
        self._fill(self._ins, t, in_step=True)
        if self._slopes is not None:
            self._slopes.take(t)
        if self._kept is not None and self.fmi.in_process:  # another process saves in the same memory again
            self._kept.free()
            self._kept, self._handle.value = None, None
        parted = self.parts & _BY_PYTHON  # parts of a step end where others begin
        self.outcome.set_span(t, self._next_stop(t, t + h) - t if parted else h)
        self.outcome.is_stepping = True
        self._calls.start()

    def finish(self) -> None:
        """End the step that has begun, and get the outputs."""
        with self._guard:
            self._end(self._calls.finish())

    def finish_native(self, t: float, h: float) -> None:
        """End a step from t over h, both in s, that C has begun in another process, and get the outputs."""
        self._t, self._h = self.outcome.now.value if StepParts.ADDED_TIME in self.parts else t, h
        self.outcome.is_stepping = True
        self.finish()

    def _end(self, status: int) -> None:
        """Continue to the end of a step whose calls have returned a status, and get the outputs."""
        fmu, outcome, t, h = self.fmu, self.outcome, self._t, self._h
        self._continue_step(self._judge_calls(status), t, h)
        outcome.set_span(t, h)
        if self._slopes is not None and (status := self._slopes.take_status()) > WARNING:
            raise outcome.report(f"setting its inputs within the step by {h:g} s", status, t)
        if not self._is_read and (status := self._reads.run()):
            self._judge_reading(self._reads, status, t if status > WARNING else t + h)
        self._spread(t + h)
        if self._texts.variables and (not self._is_read or self._watch is None or self._watch.take()):
            fmu.note_texts(t + h)
            if self._watch is not None:
                self._watch.take()
        outcome.is_stepping = False
        if self.parts & _BY_PYTHON:
            self._taken[:] = np.concatenate([np.zeros(0), *(part.values for part in self._watched)])
            ahead = math.inf if self.events is None else self.events.next_instant
            self._until[0] = -math.inf if fmu.ends_run else ahead

    def _judge_calls(self, status: int) -> int:
        """Note warnings of the calls of a step, or raise the error of one before it; return the status of the step."""
        fmu, outcome, t, found = self.fmu, self.outcome, self._t, 0
        self._is_read = not self.fmi.in_process
        if not status or status == WARNING:
            for place in self._calls.warned_places() if status else ():
                if place == self._place:
                    found = WARNING
                else:
                    fmu.judge(self._actions[place], WARNING, t if place < self._place else t + self._h)
        else:
            place = self._calls.failed
            if place < self._place:
                raise outcome.report(self._actions[place], status, t)
            found = status if place == self._place else 0
            self._is_read = False  # what has failed behind the step is read once more, where its end is judged
        if StepParts.ROLLBACK in self.parts:
            if self._kept is None or self._kept.is_free:
                self._kept = self.states.keep(self._handle)
            self._before = self._kept
        return found

    def _continue_step(self, status: int, t: float, h: float) -> None:
        """Continue from the first part of a step from t over h, in parts where events are or the FMU stops early."""
        outcome, end, now, part = self.outcome, t + h, t, self.outcome.width.value
        if not self.parts & (StepParts.EVENTS | StepParts.EARLY_RETURN):
            self._judge_part(status, t, h)
            return
        self._pile.begin(t, h)
        while True:
            reached, asks = self._judge_part(status, now, part)
            self._pile.note_end(now, reached)
            now = end if end - reached <= ROUNDED * h else reached
            if self._is_ended(t, h, now):
                return
            self._pile.note_instant(now)
            if self.events is not None and self.events.act_within(now, end, h, asked=asks):
                self._is_read = False
                if self._is_ended(t, h, now):
                    return
            if end - now <= ROUNDED * h:
                return
            stop = self._next_stop(now, end)
            part, self._is_read = stop - now, False
            if StepParts.ROLLBACK in self.parts:
                self._before = self.states.save()
            outcome.set_span(now, part)
            status = self.call.function(*self.call.arguments)

    def _is_ended(self, t: float, h: float, now: float) -> bool:
        """Return whether the FMU asks to end the simulation now; raise its error before the end of the step."""
        self.outcome.check_end(t, h, now)
        return self.fmu.ends_run

    def _judge_part(self, status: int, t: float, h: float) -> tuple[float, bool]:
        """Judge a step from t over h; return the time that it has reached, and whether the FMU asks for Event Mode."""
        fmu, outcome, call = self.fmu, self.outcome, self.call
        if status > WARNING:
            self._is_read = False
            self._judge_failure(status, t, h)
            return t + h, False
        if status:
            fmu.judge("a step", status, t)
        event, ends, early, _ = call.flags
        if early and not ends and StepParts.EARLY_RETURN in self.parts:
            return min(max(call.reached.value, t), t + h), bool(event)
        outcome.check_flags(call, t, h)
        return t + h, bool(event)

    def _judge_failure(self, status: int, t: float, h: float) -> None:
        """Wait for a step that is pending; take one that is discarded again, in parts; raise the error of a failure."""
        fmu, outcome = self.fmu, self.outcome
        status, ends = self.fmi.end_step(status)
        if ends:
            reached = self.fmi.time_after_discard(t, h)
            outcome.take_end(t, h, t if reached is None else reached)
        elif status == WARNING:
            fmu.judge("a step", status, t)
        elif status > WARNING and not (status == DISCARD and self._take_again(t, h)):
            raise outcome.step_error(status, t, h)

    def _take_again(self, t: float, h: float) -> bool:
        """Take a step from t over h that was discarded again, in smaller ones; return whether that has worked.

        With a state before it the FMU goes back to that. Else it is where it was before, in FMI 3.0 (4.2.1), or where
        its lastSuccessfulTime says, in FMI 2.0 (4.2.2); where it says nothing, the step is not taken again.
        """
        fmu, fmi, outcome, call, state = self.fmu, self.fmi, self.outcome, self.call, self._before
        if not self.options.retries or (state is None and not fmu.description.variable_step):
            return False
        end, now, part, count, status = t + h, t, h, 0, DISCARD
        smallest = h * 0.5**self.options.retries
        while True:
            if status == DISCARD:
                known = fmi.time_after_discard(now, part)
                if state is not None:
                    self.states.go_back(state)
                    part = known - now if known is not None and smallest < known - now < part else 0.5 * part
                    if part < smallest * (1.0 - ROUNDED):
                        return False
                elif known is None or part <= smallest * (1.0 + ROUNDED):
                    return False
                else:
                    now = min(max(known, now), end)
                    part = min(0.5 * part, end - now)
            else:
                now, count = now + part, count + 1
            if end - now <= ROUNDED * smallest:
                break
            if status != DISCARD and state is not None:
                state, part = self.states.save(), end - now
            part = min(part, end - now)
            outcome.set_span(now, part)
            status, ends = fmi.end_step(call.function(*call.arguments))
            if ends or (status > WARNING and status != DISCARD):
                self._judge_failure(status, now, part)
                status = 0
            elif status <= WARNING:
                fmu.judge("a step", status, now)
                if call.any_flag.value:
                    outcome.check_flags(call, now, part)
            if status <= WARNING:
                outcome.check_end(t, h, now + part)
        outcome.set_span(t, h)
        outcome.note_retry(t, h, count)
        return True

    def judge_native(self, stage: int, status: int, t: float, h: float) -> None:
        """Judge a step in C from t over h, both in s, that was out of the ordinary: raise its error, or accept it.

        It is one of a library in this process; for others see `finish_native`. ``stage`` is what was done last, with
        this status: setting the inputs (0), the step (1), reading the outputs (2).
        """
        if stage == 0 and status == WARNING:  # nothing is lost by setting the inputs once more
            self.step(t, h)
            return
        if stage != 1 and status > WARNING:
            raise self.outcome.report("setting the inputs" if stage == 0 else "reading the outputs", status, t)
        self._judge_part(status if stage == 1 else 0, t, h)

    # ---- values ----

    def exchange(self) -> None:
        """Set the inputs and get the outputs, in Initialization Mode: its passes may leave the inputs' range."""
        t = self.fmu.t
        self._fill(self._all_inputs, t)
        self._judge_reading(self._exchange, self._exchange.run(), t, n_set=len(self._all_inputs.calls))
        self._spread(t)

    def read(self, t: float) -> None:
        """Get the outputs at a time in s."""
        self._judge_reading(self._reads, self._reads.run(), t)
        self._spread(t)

    def _judge_reading(self, calls: BoundCalls, status: int, t: float, n_set: int = 0) -> None:
        """Judge calls that set some inputs and read the outputs."""
        if status:
            for place in calls.warned_places() if status == WARNING else [calls.failed]:
                self.fmu.judge("setting the inputs" if place < n_set else "reading the outputs", status, t)

    def _fill(self, inputs: Transfer, t: float, *, in_step: bool = False) -> None:
        if in_step and inputs.has_limits:
            self.fmu.check_limits(inputs, t)
        try:
            inputs.fill()
        except UnfitError as error:
            raise self.fmu.refuse(error, t) from None

    def _spread(self, t: float) -> None:
        try:
            self._outs.spread()
        except UnfitError as error:
            self.fmu.failed = True
            raise self.fmu.refuse(error, t) from None

    # ---- parts of a step ----

    def _next_stop(self, now: float, end: float) -> float:
        """Return where the next part of a step ends that is to go from now to its end."""
        if self.events is None:
            return end
        if not self.fmu.description.variable_step:
            self._refuse_clocks_within(self.events, now, end)
            return end
        stop = min(end, self.events.next_instant)
        return end if end - stop < ROUNDED * self._h else stop

    def _refuse_clocks_within(self, events: EventMode, now: float, end: float) -> None:
        """Refuse clocks that tick within the step of an FMU that takes steps of one length only."""
        for clock in events.clocks:
            if now + ROUNDED * self._h < clock.next < end - ROUNDED * self._h:
                raise FmuRuntimeError(
                    f"its clock {clock.variable.name} ticks at {clock.next:.9g} s, between two communication points, "
                    "and it takes steps of one length only (canHandleVariableCommunicationStepSize is false); expected "
                    f"steps that end there. Run with step={clock.interval:.9g}.",
                    block=self.fmu.setup.label,
                    t=now,
                )

    # ---- the start, and saved states ----

    def begin(self, t: float) -> None:
        """Settle the events at the start of a run, where the FMU is in Event Mode after its initialization."""
        assert self.events is not None
        self.forget()
        self.events.begin(t)

    def forget(self) -> None:
        """Forget the steps that were taken, before another run."""
        if StepParts.ROLLBACK in self.parts:
            self.states.final.value = False
        self._added[:] = math.nan
        if self._slopes is not None:
            self._slopes.last[:] = math.nan
        self._hold()

    def memory(self) -> StepMemory:
        """Return what the steps keep besides the FMU's own state."""
        sloped = np.zeros(0) if self._slopes is None else self._slopes.last.copy()
        return StepMemory(float(self._added[0]), sloped, None if self.events is None else self.events.memory())

    def return_to(self, t: float, memory: StepMemory | None) -> None:
        """Continue from a restored state at a time in s, of which a memory was kept, or none."""
        self.forget()
        if memory is not None:
            self._added[:] = memory.added
            if self._slopes is not None:
                self._slopes.last[:] = memory.sloped
        if self.events is not None:
            self.events.return_to(t, None if memory is None else memory.events)

    def look_at_texts(self) -> None:
        """Let the texts be read after the next step, whether they change in it or not."""
        if self._watch is not None:
            self._watch.changed.value = 1

    def _hold(self) -> None:
        """Leave the next step to Python, where C can't take each of them."""
        if self.parts & _BY_PYTHON:
            self._until[0] = -math.inf

    # ---- for loops in C ----

    @property
    def native(self) -> NativeStep | None:
        """The step as addresses; None in another process, and where it is more than three calls."""
        fmu, outcome = self.fmu, self.outcome
        is_plain = self._ins.is_plain and self._outs.is_plain and not self._ins.has_limits
        if not self.fmi.in_process or not is_plain or self.parts or self._texts.variables:
            return None
        at, call = ctypes.addressof, self.call
        return NativeStep(
            version=int(fmu.description.fmi[0]),
            instance=call.arguments[0].value,
            step=address_of(call.function),
            inputs=transfer_at(self._ins),
            outputs=transfer_at(self._outs),
            now=at(outcome.now),
            width=at(outcome.width),
            final=at(self.states.final),
            flags=at(call.flags),
            reached=at(call.reached),
            kept=(outcome.now, outcome.width, self.states.final, call, self._ins, self._outs),
            host=None if fmu.is_built_here else fmu.host,
        )

    @property
    def remote(self) -> RemoteStep | None:
        """The step in another process as addresses; None in this one, and where Python has to take each step."""
        request, call, by_python = self._calls.request, self.call, bool(self.parts & _BY_PYTHON)
        odd = (by_python and StepParts.ADDED_TIME in self.parts) or (self._texts.variables and self._watch is None)
        if request is None or odd or (given := share(self._ins, checked=True)) is None:
            return None
        quiet = None
        if self.parts or self._watch is not None:
            slopes, watched = self._slopes, [part.index for part in self._watched]
            none = np.zeros(0, dtype=np.int64)
            quiet = QuietStep(
                until=self._until,
                vector=self._ins.vector,
                watched=np.concatenate([none, *watched]),
                taken=self._taken,
                sloped=none if slopes is None else slopes.places,
                last=np.zeros(1) if slopes is None else slopes.last,
                line=None if slopes is None else slopes.line,
                slopes=None if slopes is None or slopes.line is not None else slopes.slopes,
                event=0 if self.events is None else ctypes.addressof(call.flags),
                changed=0 if self._watch is None else ctypes.addressof(self._watch.changed),
                added=self._added if StepParts.ADDED_TIME in self.parts else None,
            )
        at, outcome = ctypes.addressof, self.outcome
        return RemoteStep(
            request=request,
            inputs=given,
            outputs=share(self._outs, checked=False) or [],
            now=at(outcome.now),
            width=at(outcome.width),
            flags=at(call.flags),
            reached=at(call.reached),
            kept=(outcome.now, outcome.width, call, self._ins, self._outs),
            quiet=quiet,
            is_careful=by_python,
        )
