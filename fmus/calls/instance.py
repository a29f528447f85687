"""Instance of an FMU in a run: communication steps and saved states."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from functools import partial
from typing import Any

import numpy as np

from ...blocks.core import FmuError, FmuProcessError
from ..archive import FmuVariable
from .fmi_calls import StepCall
from .fmu_block import FmuBlock
from .loaded_library import MakeCalls
from .native_step import NativeStep, native_step
from .saved_state import FmuState, StepMemory, pack_state, unpack_state
from .shared_steps import QuietSteps, SharedSteps
from .step_failures import NEAR, StepFailures
from .step_options import adds_alone, needs_care
from .stepping import CarefulSteps
from .texts import Text, TextRecord, watch_texts
from .transfer import BoundStart, Transfer, UnfitError

_Bound = tuple[Callable[[float, float], None], Callable[[], None], Callable[[float], None]]


def _succeed() -> int:
    return 0


class FmuInstance(StepFailures):
    """Loaded FMU that takes one step at a time, through vectors that are shared with the scheduler.

    Saving and serializing its state depend on the FMU: `can_save`, `can_serialize`.
    """

    step: Callable[[float, float], None]
    """Set the inputs, take a step from a time over a length, both in s, and get the outputs (after `bind`)."""
    start_step: Callable[[float, float], None]
    """Begin a step, as `step`; one in another process goes on by itself until `finish_step` (after `bind`)."""
    finish_step: Callable[[], None]
    """End the step that `start_step` has begun, and get the outputs."""
    exchange: Callable[[], None]
    """In Initialization Mode: set the inputs and get the outputs (after `bind`)."""

    read: Callable[[float], None]
    """Get the outputs at a time in s (after `bind`)."""

    def __init__(self, block: FmuBlock, wired: Sequence[str], *, make_calls: MakeCalls | None = None):
        super().__init__(block, make_calls=make_calls)
        self._has_retried = False
        self._call: StepCall | None = None
        variables = block.input_variables
        self._inputs, self._outputs = {port: variables[port] for port in wired}, dict(block.output_variables)
        self._now, self._width = self.fmi.variable(ctypes.c_double), self.fmi.variable(ctypes.c_double)
        self._final = self.fmi.final  # noSetFMUStatePriorToCurrentPoint, until a state has been saved
        self._vector = np.zeros(0)
        self._asked = (0.0, 0.0)
        self.start_step, self.finish_step = self._ask, self._take
        self._handles: dict[int, Any] = {}
        self.read = lambda t: None
        self._texts = TextRecord(self.fmi, block.text_variables)
        self._native: tuple[StepCall, Transfer, Transfer] | None = None
        self._starts: dict[tuple[str, ...], BoundStart | None] = {}

    @property
    def t(self) -> float:
        """Time of the instance in s."""
        return self._now.value + self._width.value if self._running else self._began

    def begin(self) -> None:
        """Leave Initialization Mode and read the outputs at the start of the run."""
        with self.host if self._start is None else nullcontext():
            super().begin()
            self._now.value, self._width.value = self._began, 0.0
            self.read(self._began)
            if self._texts.variables:
                self._begin_texts()

    def start_anew(self, values: Mapping[str, np.ndarray]) -> None:
        """Reset it, set start values and enter Initialization Mode at t = 0, as `reset` and `initialize` do.

        An FMU that Loopwright has built, with a plain step (`native`), is started by a few calls that are bound once.

        Parameters
        ----------
        values : mapping of str to array
            Start values beside those of the block, which they override, by the FMU's names.
        """
        self.reset()
        if self._careful is not None:
            self._careful.added[:] = math.nan
        given = {**self.block.start, **values}
        if (names := tuple(given)) not in self._starts:
            fits = self._native is not None and self.is_built_here and BoundStart.fits(self.description, names)
            self._starts[names] = BoundStart(self.fmi, self.description, names) if fits else None
        start = self._starts[names]
        if start is not None:
            self._began, self._given = 0.0, given
            try:
                entered = start.enter(given, self.block.stepping.tolerance)
            except Exception as error:
                raise self._initialization_error(error) from error
            if entered:
                self._start = start
                return
            self.reset()
        self.initialize(None, values=values)

    def _settle_start(self) -> None:
        if self._careful is None:
            super()._settle_start()
        else:
            self._careful.begin(self._began)
            if self._quiet is not None:
                self._quiet.hold()

    def bind(self, inputs: np.ndarray, outputs: np.ndarray) -> None:
        """Bind the vectors of the inputs to set and of the outputs to get, and get the outputs once."""
        self._vector = inputs
        ins, outs = Transfer(self.fmi, "Set", self._inputs, inputs), Transfer(self.fmi, "Get", self._outputs, outputs)
        call = self.fmi.step_call(self._now, self._width, self._final)
        plain = ins.is_plain and outs.is_plain and not ins.has_limits
        careful = needs_care(self.description, self.block.stepping)
        if careful:
            self._careful = CarefulSteps(self, self._inputs, inputs, outs, call)
        adds = not self.fmi.in_process and adds_alone(self.description, self.block.stepping)
        if self.fmi.in_process:
            self.step, self.exchange, self.read = (self._bind_plain if plain else self._bind_typed)(ins, outs, call)
        else:
            self._watch = watch = watch_texts(self.fmi, self._texts.variables.values())
            added = self._careful.added if adds and self._careful is not None else None
            shared = SharedSteps(self, ins, outs, call, None if careful and not adds else watch, added)
            self.step, self.exchange, self.read = shared.bind_step(), shared.exchange, shared.read
            self.start_step, self.finish_step = shared.start, shared.finish
            plain = (adds or not careful) and (watch is not None or not self._texts.variables)
            self._shared = shared if plain else None
        self._call = call
        plain = plain and self.fmi.in_process and not careful and not self._texts.variables
        self._native = (call, ins, outs) if plain else None
        if self._careful is not None and not adds:
            self.step = partial(self._step_marked, self._careful.step)
            if not self.fmi.in_process and (self._watch is not None or not self._texts.variables):
                self._quiet = QuietSteps(self, self._careful, self._watch)
        if self._texts.variables:
            self.step = partial(self._step_and_note, self.step)
        if self.fmi.in_process and not self.is_built_here:
            self.step = partial(self._step_guarded, self.step)
        if isinstance(self.step, partial):
            self.start_step, self.finish_step = self._ask, self._take
        self.read(self._began)

    @property
    def native(self) -> NativeStep | None:
        """Its step as addresses; None in another process, and where a step is more than three calls."""
        if self._native is None:
            return None
        host = None if self.is_built_here else self.host
        return native_step(self.description.fmi, self._now, self._width, self._final, *self._native, host=host)

    def _ask(self, t: float, h: float) -> None:
        self._asked = t, h

    def _take(self) -> None:
        self.step(*self._asked)

    def _begin_texts(self) -> None:
        """Let the record of texts go on from the present time."""
        if self._watch is not None:
            self._watch.changed.value = 1
        for text in self.call("reading its texts", self._texts.go_back, self.t):
            self.add_note(text)

    def _step_and_note(self, step: Callable[[float, float], None], t: float, h: float) -> None:
        step(t, h)
        self._note_texts(t + h)

    def _step_guarded(self, step: Callable[[float, float], None], t: float, h: float) -> None:
        with self.host:
            step(t, h)

    @property
    def texts(self) -> Mapping[str, list[tuple[float, Text]]]:
        """Texts and binary data by port: each value with the time in s from which on it held."""
        return self._texts.values

    def _bind_plain(self, ins: Transfer, outs: Transfer, call: StepCall) -> _Bound:
        """Return step, exchange and reading where all ports are Float64: one call each way, on the vectors."""
        set_values, set_arguments = ins.plain_call or (_succeed, ())
        get_values, get_arguments = outs.plain_call or (_succeed, ())
        do_step, step_arguments, any_flag, reached = call.function, call.arguments, call.any_flag, call.reached
        now, width = self._now, self._width
        has_inputs, has_outputs = ins.plain_call is not None, outs.plain_call is not None

        def step(t: float, h: float) -> None:
            if has_inputs and (status := set_values(*set_arguments)):
                self.judge("setting the inputs", status, t)
            now.value, width.value = t, h
            if status := do_step(*step_arguments):
                self.end_step(status, t, h)
            if any_flag.value or abs(reached.value - t - h) > h * NEAR:
                self.check_flags(call, t, h)
            if has_outputs and (status := get_values(*get_arguments)):
                self.judge("reading the outputs", status, t)

        def read(t: float) -> None:
            if has_outputs and (status := get_values(*get_arguments)):
                self.judge("reading the outputs", status, t)

        def exchange() -> None:
            if has_inputs and (status := set_values(*set_arguments)):
                self.judge("setting the inputs", status, self._began)
            read(self._began)

        return step, exchange, read

    def _bind_typed(self, ins: Transfer, outs: Transfer, call: StepCall) -> _Bound:
        """Return step, exchange and reading where ports have several types."""

        def write(t: float, *, in_step: bool = False) -> None:
            if in_step and ins.has_limits:  # passes of the initialization may leave the range on their way
                self.check_limits(ins, t)
            try:
                status = ins.set()
            except UnfitError as error:
                raise self.refuse_input(error, t) from None
            if status:
                self.judge("setting the inputs", status, t)

        def read(t: float) -> None:
            try:
                status = outs.get()
            except UnfitError as error:
                raise self.refuse_output(error, t) from None
            if status:
                self.judge("reading the outputs", status, t)

        def step(t: float, h: float) -> None:
            write(t, in_step=True)
            self._now.value, self._width.value = t, h
            if status := call.function(*call.arguments):
                self.end_step(status, t, h)
            if call.any_flag.value or abs(call.reached.value - t - h) > h * NEAR:
                self.check_flags(call, t, h)
            read(t + h)

        def exchange() -> None:
            write(self._began)
            read(self._began)

        return step, exchange, read

    def lose(self, error: FmuProcessError) -> FmuProcessError:
        """Note that the process of the FMU has ended, in a step at its start."""
        if self.is_stepping:
            self._width.value = 0.0
        return super().lose(error)

    def operating_point(self) -> dict[str, Any]:
        """Return the present ``t``, ``state`` and ``inputs``, for `Fmu.linear_model` and `Fmu.step_difference`."""
        about = self.description

        def read(variable: FmuVariable) -> np.ndarray:
            return self.read_variables([variable]).reshape(variable.shape)

        state = {name: read(about.variables[name]) for name in (*about.states, *about.discrete_states)}
        inputs = {port: read(variable) for port, variable in self.block.input_variables.items()}
        return {"t": self.t, "state": state, "inputs": inputs}

    # ---- saved states (FMI 2.0, 2.1.8; FMI 3.0, 2.2.6.4) ----

    @property
    def can_save(self) -> bool:
        """Whether its state can be saved and restored."""
        return self.description.can_save

    @property
    def can_serialize(self) -> bool:
        """Whether a saved state can be turned into bytes."""
        return self.description.can_serialize

    def save(self) -> FmuState:
        """Save the present state with all its parts: states, inputs, parameters, memory of the solver.

        Returns
        -------
        FmuState
            For `restore` and `serialize` of the same instance.

        Raises
        ------
        FmuError
            If the FMU can't save its state (`can_save`).
        FmuRuntimeError
            If the FMU's function fails.
        """
        self._check_can(self.description.state_flags[0], "saved", self.can_save)
        steps = None if self._careful is None else self._careful.memory()
        return self._keep(self.call("saving its state", self.fmi.save_state), self.t, self._running, steps)

    def keep(self, handle: Any) -> FmuState:
        """Return the saved state of a handle at the present time, for steps that are taken again."""
        return self._keep(handle, self.t, self._running)

    def go_back(self, state: FmuState) -> None:
        """Set the FMU back to a state, without its outputs; for steps that are taken again."""
        self.ends_run = False
        self.call("restoring its state", self.fmi.set_state, state._handle)

    def restore(self, state: FmuState) -> None:
        """Restore a saved state, earlier or later, and get the outputs there; this is allowed after an error, too.

        Raises
        ------
        FmuError
            If the state belongs to another instance, or has been freed.
        FmuRuntimeError
            If the FMU's function fails.
        """
        self._check_state(state)
        self.call("restoring its state", self.fmi.set_state, state._handle)
        self.failed, self._running, self.ends_run, self.refused = False, state.running, False, None
        self._now.value, self._width.value = state.t, 0.0
        if self._careful is not None:
            self._careful.return_to(state.t, state.steps)
        if self._quiet is not None:
            self._quiet.hold()
        self.read(state.t)
        self._begin_texts()

    def serialize(self, state: FmuState | None = None) -> bytes:
        """Return a saved state, or the present one, as bytes.

        An FMU of the same content on the same platform can read them, so that a run continues in another process.

        Raises
        ------
        FmuError
            If the FMU can't serialize its state (`can_serialize`), or the state belongs to another instance.
        FmuRuntimeError
            If the FMU's function fails.
        """
        self._check_can(self.description.state_flags[1], "turned into bytes", self.can_serialize)
        if state is None:
            state = self.save()
        self._check_state(state)
        data = self.call("serializing its state", self.fmi.serialize_state, state._handle)
        return pack_state(self.description.digest, state.t, state.running, bytes(data))

    def deserialize(self, data: bytes) -> FmuState:
        """Return a state of this instance, made from bytes; `restore` it after `begin`.

        Raises
        ------
        FmuError
            If the bytes are no state of this FMU on this platform.
        FmuRuntimeError
            If the FMU's function fails.
        """
        self._check_can(self.description.state_flags[1], "made from bytes", self.can_serialize)
        t, running, rest = unpack_state(data, self.description.digest, self.block.label)
        return self._keep(self.call("reading a serialized state", self.fmi.deserialize_state, rest), t, running)

    def _keep(self, handle: Any, t: float, running: bool, steps: StepMemory | None = None) -> FmuState:
        self._final.value = False  # the FMU may be set back from now on
        self._handles[id(handle)] = handle
        return FmuState(self, handle, t, running, steps)

    def release(self, handle: Any) -> None:
        """Free the saved state of a handle, once."""
        if self._handles.pop(id(handle), None) is not None:
            self.free_state(handle)

    def _check_can(self, flag: str, action: str, can: bool) -> None:
        if not self._open:
            text = f"its run is over, so no state can be {action}. Do it within the run."
            raise FmuError(text, block=self.block.label)
        if not can:
            raise FmuError(
                f"its state can't be {action}: {flag} is false in the FMU's description. Export it with that "
                "capability, or run again from the start.",
                block=self.block.label,
            )

    def _check_state(self, state: FmuState) -> None:
        self._check_can(self.description.state_flags[0], "restored", self.can_save)
        if state.instance is not self:
            raise FmuError(
                f"found a state of another instance, {state!r}. Carry it over: restore(deserialize(data)) with the "
                "data of that instance's serialize().",
                block=self.block.label,
            )
        if state.is_free:
            raise FmuError(
                f"found a state that has been freed, {state!r}. Keep it until it is restored.", block=self.block.label
            )

    def close(self) -> None:
        """Free the saved states, then terminate and free the instance."""
        if self._open:
            for handle in list(self._handles.values()):
                self.release(handle)
        super().close()
