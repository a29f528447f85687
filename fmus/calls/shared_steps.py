"""Steps and readings of an instance whose library stands in another process: one round trip each."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from ..archive import FmuVariable
from .bound_calls import WARNING, BoundCalls
from .fmi_calls import FmiCalls, StepCall
from .native_step import RemoteStep, remote_step
from .stepped_instance import SteppedInstance as Judge
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
    """

    def __init__(self, instance: SteppedInstance, ins: Transfer, outs: Transfer, call: StepCall):
        self.instance, self.ins, self.outs, self.call = instance, ins, outs, call
        bind, self._t, self._h = instance.fmi.bind, 0.0, 0.0
        self._n_in = len(ins.calls)
        self._step = bind([*ins.calls, (call.function, call.arguments), *outs.calls])
        self._exchange = bind([*ins.calls, *outs.calls])
        self._read = bind(outs.calls)

    def bind_step(self) -> Callable[[float, float], None]:
        """Return `step`, for ports that are Float64 all as one function, which costs less."""
        instance, call, run = self.instance, self.call, self._step.runner()
        if not (self.ins.is_whole and self.outs.is_whole) or self.ins.has_limits:
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
    def has_request(self) -> bool:
        """Whether C can ask for the step."""
        return self._step.request is not None

    @property
    def remote(self) -> RemoteStep | None:
        """The step as addresses, for a loop in C; None where C can't ask for it."""
        request, instance = self._step.request, self.instance
        if request is None:
            return None
        return remote_step(request, instance.now, instance.width, self.call, self.ins, self.outs)

    def take_over(self, t: float, h: float) -> None:
        """Go on with a step from t over h, both in s, that C has begun: `finish` ends it."""
        self._t, self._h = t, h
        self.instance.is_stepping = True

    def start(self, t: float, h: float) -> None:
        """Set the inputs, and begin a step from a time over a length, both in s."""
        instance = self.instance
        self._fill(t, in_step=True)
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
                self.instance.judge(self._action(place, self._n_in, "a step"), status, t + h * (place > self._n_in))
            return
        place = self._step.failed
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
