"""Steps and readings of an instance whose library stands in another process: one round trip each."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from ..archive import FmuVariable
from .bound_calls import WARNING, BoundCalls
from .fmi_calls import FmiCalls, StepCall
from .native_step import QuietStep, RemoteStep, remote_step
from .saved_state import FmuState
from .step_options import StepTime, add_step
from .stepped_instance import SteppedInstance as Judge
from .stepping import CarefulSteps
from .texts import TextWatch
from .transfer import Transfer, UnfitError

_NEAR = 1e-6  # distance from the end of a step, in steps, within which a time is that end
_MOST = 50
"""Lists whose calls are kept; others are read type by type."""


class SteppedInstance(Judge, Protocol):
    """Instance that takes the steps, and words their errors."""

    is_stepping: bool
    """Whether a step is under way."""

    @property
    def t(self) -> float:
        """Time in s."""

    @property
    def now(self) -> ctypes.c_double:
        """Start of the step in s."""

    @property
    def width(self) -> ctypes.c_double:
        """Length of the step in s."""

    def keep(self, handle: Any) -> FmuState:
        """Return the saved state of a handle at the present time."""


class SharedSteps:
    """Setting the inputs, a step, and getting the outputs, bound as one sequence of calls.

    Parameters
    ----------
    instance : SteppedInstance
        The instance, which words the errors.
    ins, outs : Transfer
        Inputs to set and outputs to get.
    call : StepCall
        The step.
    watch : TextWatch, optional
        Calls that note whether texts have changed.
    added : ndarray, shape (1,), optional
        Time in s that steps have added up to; see `add_step`. Without it steps begin at the times of the run.
    """

    def __init__(
        self,
        instance: SteppedInstance,
        ins: Transfer,
        outs: Transfer,
        call: StepCall,
        watch: TextWatch | None = None,
        added: np.ndarray | None = None,
    ):
        self.instance, self.ins, self.outs, self.call, self._watch = instance, ins, outs, call, watch
        self._added = added
        bind, self._t, self._h = instance.fmi.bind, 0.0, 0.0
        self._n_in, self._n_out = len(ins.calls), len(ins.calls) + len(outs.calls)
        texts = [] if watch is None else watch.calls
        self._step = bind([*ins.calls, (call.function, call.arguments), *outs.calls, *texts])
        self._exchange = bind([*ins.calls, *outs.calls])
        self._read = bind(outs.calls)

    def bind_step(self) -> Callable[[float, float], None]:
        """Return `step`, for ports that are Float64 all as one function, which costs less."""
        instance, call, run = self.instance, self.call, self._step.runner()
        if not (self.ins.is_whole and self.outs.is_whole) or self.ins.has_limits or self._added is not None:
            return self.step
        filled, spread = self.ins.views, self.outs.views  # (from, to) each, in the sense of setting
        now, width, any_flag, reached = instance.now, instance.width, call.any_flag, call.reached

        def step(t: float, h: float) -> None:
            for here, there in filled:
                there[:] = here
            now.value, width.value = t, h
            instance.is_stepping = True
            status = run()
            if status:
                self._judge(status, t, h)
            instance.is_stepping = False
            if any_flag.value or abs(reached.value - t - h) > h * _NEAR:
                instance.check_flags(call, t, h)
            for here, there in spread:
                here[:] = there

        return step

    @property
    def remote(self) -> RemoteStep | None:
        """The step as addresses, for a loop in C; None where C can't ask for it."""
        request, instance = self._step.request, self.instance
        if request is None:
            return None
        step = remote_step(request, instance.now, instance.width, self.call, self.ins, self.outs)
        if step is None or (self._watch is None and self._added is None):
            return step
        none, changed = np.zeros(0, dtype=np.int64), 0 if self._watch is None else ctypes.addressof(self._watch.changed)
        quiet = QuietStep(
            np.full(1, math.inf), self.ins.vector, none, np.zeros(0), none, np.zeros(1), None, None, 0, changed,
            self._added,
        )  # fmt: skip
        return replace(step, quiet=quiet)

    def take_over(self, t: float, h: float) -> None:
        """Go on with a step from t over h, both in s, that C has begun: `finish` ends it."""
        self._t, self._h = t if self._added is None else self.instance.now.value, h
        self.instance.is_stepping = True

    def start(self, t: float, h: float) -> None:
        """Set the inputs, and begin a step from a time over a length, both in s."""
        instance = self.instance
        self._fill(t, in_step=True)
        if self._added is not None:
            t = add_step(self._added, t, h)
        instance.set_span(t, h)
        self._t, self._h = t, h
        instance.is_stepping = True
        self._step.start()

    def finish(self) -> None:
        """Wait for the end of the step, and get the outputs."""
        instance, t, h, call = self.instance, self._t, self._h, self.call
        status = self._step.finish()
        if status:
            self._judge(status, t, h)
        instance.is_stepping = False
        if call.any_flag.value or abs(call.reached.value - t - h) > h * _NEAR:
            instance.check_flags(call, t, h)
        self._spread(t + h)

    def step(self, t: float, h: float) -> None:
        """Set the inputs, take a step from a time over a length, both in s, and get the outputs."""
        self.start(t, h)
        self.finish()

    def exchange(self) -> None:
        """Set the inputs and get the outputs."""
        t = self.instance.t
        self._fill(t)
        self._run(self._exchange, t, self._n_in)

    def read(self, t: float) -> None:
        """Get the outputs."""
        self._run(self._read, t, 0)

    def _judge(self, status: int, t: float, h: float) -> None:
        """Wait for a step that is pending and read the outputs; note a warning, or raise the error of a failure."""
        if status == WARNING:
            for place in self._step.warned_places():
                if place > self._n_out:  # reading the texts tells of it
                    continue
                self.instance.judge(self._action(place, self._n_in, "a step"), status, t + h * (place > self._n_in))
            return
        place = self._step.failed
        if place > self._n_out and self._watch is not None:
            self._watch.changed.value = 1
            return
        if place == self._n_in:
            self.instance.end_step(status, t, h)
            status = self._read.run()
        self.instance.judge("setting the inputs" if place < self._n_in else "reading the outputs", status, t)

    @staticmethod
    def _action(place: int, n_in: int, between: str) -> str:
        return "setting the inputs" if place < n_in else between if place == n_in else "reading the outputs"

    def _run(self, bound: BoundCalls, t: float, n_in: int) -> None:
        status = bound.run()
        if status:
            for place in bound.warned_places() if status == WARNING else [bound.failed]:
                self.instance.judge(self._action(place, n_in, "reading the outputs"), status, t)
        self._spread(t)

    def _fill(self, t: float, *, in_step: bool = False) -> None:
        if in_step and self.ins.has_limits:
            self.instance.check_limits(self.ins, t)
        try:
            self.ins.fill()
        except UnfitError as error:
            raise self.instance.refuse_input(error, t) from None

    def _spread(self, t: float) -> None:
        try:
            self.outs.spread()
        except UnfitError as error:
            raise self.instance.refuse_output(error, t) from None


class QuietSteps:
    """Steps that may be more than their calls, as C takes those at which nothing else is to be done.

    All others are Python's, the first one, too; after each of them C is told how far it may go.

    Parameters
    ----------
    instance : SteppedInstance
        The instance.
    careful : CarefulSteps
        Its steps.
    watch : TextWatch or None
        Texts that are recorded.
    """

    def __init__(self, instance: SteppedInstance, careful: CarefulSteps, watch: TextWatch | None):
        self.instance, self.careful, self._watch, fmi = instance, careful, watch, instance.fmi
        self._until = np.full(1, -math.inf)
        parts = [careful.jumping, *(part for _, part in careful.clocked)]
        self._watched = np.concatenate([np.zeros(0, dtype=np.int64), *(part.index for part in parts)])
        self._parts, self._taken = parts, np.zeros(self._watched.size)
        self._kept: FmuState | None = None
        self._handle = fmi.variable(ctypes.c_void_p)
        references, n = careful.sloped_references, careful.sloped.size
        self._line = fmi.slope_line(references, n) if n else None
        self._slopes = fmi.allocate(n, ctypes.c_double) if n and self._line is None else None
        calls = [*careful.smooth.transfer.calls]
        if self._slopes is not None:
            kept, orders = (ctypes.c_uint * n)(*references), (ctypes.c_int * n)(*[1] * n)
            slopes = kept, ctypes.c_size_t(n), orders, ctypes.c_void_p(self._slopes.ctypes.data)
            calls.append((fmi.function("SetRealInputDerivatives"), (fmi.instance_argument, *slopes)))
        if careful.options.rollback:
            name = "GetFMUState" if fmi.prefix == "fmi3" else "GetFMUstate"
            calls.append((fmi.function(name), (fmi.instance_argument, ctypes.byref(self._handle))))
        self._n_step, call = len(calls), careful.call
        texts = [] if watch is None else watch.calls
        self._bound = fmi.bind([*calls, (call.function, call.arguments), *careful.outs.calls, *texts])

    def hold(self) -> None:
        """Leave the next step to Python."""
        self._until[0] = -math.inf

    def renew(self) -> None:
        """Let C take steps up to the next event, after one by Python."""
        careful, instance = self.careful, self.instance
        if careful.options.rollback and self._kept is None:
            self._handle.value = instance.call("saving its state", instance.fmi.save_state).value
            self._kept = instance.keep(self._handle)
        self._taken[:] = np.concatenate([np.zeros(0), *(part.values for part in self._parts)])
        self._until[0] = -math.inf if instance.ends_run else careful.next_instant

    @property
    def remote(self) -> RemoteStep | None:
        """A step as addresses, for a loop in C; None where C can't ask for it."""
        request, careful = self._bound.request, self.careful
        if request is None or careful.options.time is StepTime.ADDED:
            return None
        smooth, instance = careful.smooth, self.instance
        step = remote_step(request, instance.now, instance.width, careful.call, smooth.transfer, careful.outs)
        if step is None:
            return None
        inputs = [
            replace(of, vector=smooth.source, index=smooth.index[... if of.index is None else of.index])
            for of in step.inputs
        ]
        event = ctypes.addressof(careful.call.flags) if careful.has_events else 0
        changed = 0 if self._watch is None else ctypes.addressof(self._watch.changed)
        places = smooth.index[careful.sloped]
        quiet = QuietStep(
            self._until, smooth.source, self._watched, self._taken, places, careful.last, self._line, self._slopes,
            event, changed,
        )  # fmt: skip
        return replace(step, inputs=inputs, quiet=quiet, is_careful=True)

    def finish(self, t: float, h: float) -> None:
        """End a step from t over h, both in s, that C has begun."""
        careful, status = self.careful, self._bound.finish()
        taken, place = 0, self._bound.failed
        if status == WARNING:
            for place in self._bound.warned_places():
                if place < len(careful.smooth.transfer.calls):
                    self.instance.judge("setting the inputs", status, t)
                taken = WARNING if place == self._n_step else taken
        elif status and place < self._n_step:  # nothing is lost by doing all of it once more
            careful.step(t, h)
            return
        elif place == self._n_step:
            taken = status
        careful.go_on(t, h, taken, self._kept)


class SharedReading:
    """Calls that read lists of variables, bound when a list is read for the second time."""

    def __init__(self, fmi: FmiCalls):
        self.fmi = fmi
        self._seen: set[tuple[str, ...]] = set()
        self._lists: dict[tuple[str, ...], tuple[BoundCalls, list[np.ndarray]]] = {}

    def read(self, groups: Sequence[Sequence[FmuVariable]]) -> list[np.ndarray]:
        """Return the values of each group of variables of one type; nothing in process, or where a call fails."""
        key = tuple(v.name for group in groups for v in group)
        if self.fmi.in_process or not key:
            return []
        if key not in self._lists:
            if key not in self._seen or len(self._lists) >= _MOST:
                self._seen.add(key)
                return []
            self._lists[key] = self._bind(groups)
        bound, values = self._lists[key]
        return [np.array(v) for v in values] if 0 <= bound.run() <= WARNING else []

    def _bind(self, groups: Sequence[Sequence[FmuVariable]]) -> tuple[BoundCalls, list[np.ndarray]]:
        calls, values = [], []
        for group in groups:
            type_, size = group[0].type, sum(v.size for v in group)
            references = [r for v in group for r in v.references]
            kept = (ctypes.c_uint * len(references))(*references)
            buffer = self.fmi.allocate(size, self.fmi.types[type_].ctype)
            arguments = self.fmi.value_arguments(kept, len(references), buffer.ctypes.data, size)
            calls.append((self.fmi.value_function("Get", type_), arguments))
            values.append(buffer)
        return self.fmi.bind(calls), values
