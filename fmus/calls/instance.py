"""Instance of an FMU in a run: communication steps and saved states."""

from __future__ import annotations

import ctypes
import struct
import weakref
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from ...blocks.core import FmuError, FmuRuntimeError
from ..platform import native_platform
from .fmu_block import FmuBlock
from .loaded_library import LoadedFmu, status_of

_HEADER = struct.Struct("<8s32s24sd?")  # of a serialized state: magic, FMU's digest, platform, time, running
_MAGIC = b"lw-fmu-1"
_DISCARD = 2
_BEYOND = 1.0 + 1e-6  # end of a step, in steps, beyond which more than rounding has been added


class FmuState:
    """Saved state of an `FmuInstance`: all of its memory at one time, and that time.

    It belongs to the instance that made it, and is freed with it, or when nothing refers to it any more.
    """

    def __init__(self, instance: FmuInstance, handle: Any, t: float, running: bool):
        self.instance, self.t, self.running = instance, t, running
        self._handle = handle
        self._free = weakref.finalize(self, instance._release, handle)
        self._free.atexit = False  # the end of the process frees the memory anyway

    @property
    def is_free(self) -> bool:
        """Whether the state has been freed, so that it can't be restored any more."""
        return not self._free.alive

    def free(self) -> None:
        """Free the state's memory in the FMU."""
        self._free()

    def __repr__(self) -> str:
        return f"FmuState({self.instance.block.label}, t={self.t:.9g}{', freed' if self.is_free else ''})"


class FmuInstance(LoadedFmu):
    """Loaded FMU that takes one step at a time, through vectors that are shared with the scheduler.

    Saving and serializing its state depend on the FMU: `can_save`, `can_serialize`.
    """

    step: Callable[[float, float], None]
    """Set the inputs, take a step from a time over a length, both in s, and get the outputs (after `bind`)."""
    exchange: Callable[[], None]
    """In Initialization Mode: set the inputs and get the outputs (after `bind`)."""

    def __init__(self, block: FmuBlock, wired: Sequence[str]):
        super().__init__(block)
        back = {new: old for old, new in block.rename.items()}
        self._inputs = [self.description.variables[back.get(name, name)] for name in wired]
        self._outputs = list(self.description.of("output").values())
        self._now, self._width = ctypes.c_double(), ctypes.c_double()
        self._final = ctypes.c_bool(True)  # noSetFMUStatePriorToCurrentPoint, until a state has been saved
        self._handles: dict[int, Any] = {}
        self._read: Callable[[float], None] = lambda t: None

    @property
    def t(self) -> float:
        """Time of the instance in s."""
        return self._now.value + self._width.value if self._running else self._began

    def begin(self) -> None:
        """Leave Initialization Mode and read the outputs at the start of the run."""
        super().begin()
        self._now.value, self._width.value = self._began, 0.0
        self._read(self._began)

    def bind(self, inputs: np.ndarray, outputs: np.ndarray) -> None:
        """Bind the vectors of the inputs to set and of the outputs to get, and get the outputs once."""
        lib, component = self._fmu.dll, ctypes.c_void_p(self._fmu.component)
        set_values, get_values, do_step = lib["fmi3SetFloat64"], lib["fmi3GetFloat64"], lib["fmi3DoStep"]
        for function in (set_values, get_values, do_step):
            function.restype = ctypes.c_int  # arguments are made once, so that no call checks their types
        flags = (ctypes.c_bool * 4)()  # event, terminate, early return, and one that is never set
        any_flag = ctypes.c_uint32.from_buffer(flags)
        reached = ctypes.c_double()
        ins = (ctypes.c_uint * max(1, len(self._inputs)))(*[v.reference for v in self._inputs])
        outs = (ctypes.c_uint * max(1, len(self._outputs)))(*[v.reference for v in self._outputs])
        self._kept = (ins, outs, flags, reached, inputs, outputs)  # kept alive as long as their addresses are used
        address, size, now, width = ctypes.c_void_p, ctypes.c_size_t, self._now, self._width
        set_arguments = (component, ins, size(len(self._inputs)), address(inputs.ctypes.data), size(inputs.size))
        get_arguments = (component, outs, size(len(self._outputs)), address(outputs.ctypes.data), size(outputs.size))
        at = ctypes.addressof(flags)
        step_arguments = (
            *(component, now, width, self._final),
            *(address(at), address(at + 1), address(at + 2), ctypes.byref(reached)),
        )
        has_inputs, has_outputs = bool(self._inputs), bool(self._outputs)

        def step(t: float, h: float) -> None:
            if has_inputs and (status := set_values(*set_arguments)) > 1:
                raise self._error("setting the inputs", status, t)
            now.value, width.value = t, h
            if (status := do_step(*step_arguments)) > 1:
                raise self._step_error(status, t, h)
            if any_flag.value or reached.value > t + h * _BEYOND:
                self._check_flags(flags, reached.value, t, h)
            if has_outputs and (status := get_values(*get_arguments)) > 1:
                raise self._error("reading the outputs", status, t)

        def read(t: float) -> None:
            if has_outputs and (status := get_values(*get_arguments)) > 1:
                raise self._error("reading the outputs", status, t)

        def exchange() -> None:
            if has_inputs and (status := set_values(*set_arguments)) > 1:
                raise self._error("setting the inputs", status, self._began)
            read(self._began)

        self.step, self.exchange, self._read = step, exchange, read
        read(self._began)

    # ---- failures of a step (FMI 3.0, 2.2.3 and 4.2.1) ----

    def _mark_failure(self, status: int) -> None:
        self.failed = status > _DISCARD  # a call that is discarded changes nothing
        self.fatal = status > _DISCARD + 1

    def _error(self, action: str, status: int, t: float, advice: str = "") -> FmuRuntimeError:
        self._mark_failure(status)
        inputs = ", ".join(f"{v.name}" for v in self._inputs)
        values = self._kept[4].tolist()
        return FmuRuntimeError(
            f"{action} failed with {status_of(status)}{self._quote_messages()} The inputs ({inputs}) were {values}. "
            f"{advice or 'Look at the last samples of error.run, or take a smaller step.'}",
            block=self.block.label,
            t=t,
        )

    def _step_error(self, status: int, t: float, h: float) -> FmuRuntimeError:
        self._width.value = 0.0  # the instance stays where it was
        action = f"the step from t = {t:.9g} s by {h:g} s"
        if status != _DISCARD:
            return self._error(action, status, t)
        steps = "" if self.block.variable_step else " from the start: this FMU takes steps of one length only"
        return self._error(
            f"{action} was discarded, as the FMU can't compute it: it",
            status,
            t,
            f"Take a smaller step{steps}, or check the FMU's inputs there.",
        )

    def _check_flags(self, flags: Any, reached: float, t: float, h: float) -> None:
        _, terminate, early, _ = flags
        if terminate:
            raise FmuRuntimeError(
                f"the FMU asks to end the simulation (terminateSimulation) in the step from t = {t:.9g} s by {h:g} s"
                f"{self._quote_messages()} End the run there, or look up the reason in the FMU's documentation.",
                block=self.block.label,
                t=t,
            )
        if early:
            raise FmuRuntimeError(
                f"the step from t = {t:.9g} s by {h:g} s returned early, at {reached:.9g} s (earlyReturn), though the "
                f"FMU was told that it must not (earlyReturnAllowed = false){self._quote_messages()} Take steps that "
                "end where its events are, or export it without early return.",
                block=self.block.label,
                t=t,
            )
        if reached > t + h * _BEYOND + 1e-12 * abs(t):
            raise FmuRuntimeError(
                f"the step from t = {t:.9g} s by {h:g} s ended at {reached:.9g} s (lastSuccessfulTime); expected "
                f"{t + h:.9g} s{self._quote_messages()} Its outputs belong to another time than the diagram's: report "
                "it to its makers.",
                block=self.block.label,
                t=t,
            )

    def operating_point(self) -> dict[str, Any]:
        """Return the present ``t``, ``state`` and ``inputs``, for `Fmu.linear_model` and `Fmu.step_difference`."""
        about, rename = self.description, self.block.rename

        def read(names: Iterable[str]) -> dict[str, np.ndarray]:
            return {name: self.values([name]).reshape(about.variables[name].shape) for name in names}

        inputs = {rename.get(name, name): value for name, value in read(about.of("input")).items()}
        return {"t": self.t, "state": read((*about.states, *about.discrete_states)), "inputs": inputs}

    # ---- saved states (FMI 3.0, 2.2.6.4) ----

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
        self._check_can("canGetAndSetFMUState", "saved", self.can_save)
        return self._keep(self.call("saving its state", "getFMUState"), self.t, self._running)

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
        self.call("restoring its state", "setFMUState", state._handle)
        self.failed, self._running = False, state.running
        self._now.value, self._width.value = state.t, 0.0
        self._read(state.t)

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
        self._check_can("canSerializeFMUState", "turned into bytes", self.can_serialize)
        if state is None:
            state = self.save()
        self._check_state(state)
        data = self.call("serializing its state", "serializeFMUState", state._handle)
        return _HEADER.pack(_MAGIC, *self._identity(), state.t, state.running) + bytes(data)

    def deserialize(self, data: bytes) -> FmuState:
        """Return a state of this instance, made from bytes; `restore` it after `begin`.

        Raises
        ------
        FmuError
            If the bytes are no state of this FMU on this platform.
        FmuRuntimeError
            If the FMU's function fails.
        """
        self._check_can("canSerializeFMUState", "made from bytes", self.can_serialize)
        head, rest = data[: _HEADER.size], data[_HEADER.size :]
        if len(head) < _HEADER.size or not head.startswith(_MAGIC):
            raise FmuError(
                f"found {len(data)} bytes that are no state of an FMU; expected those of serialize(). Give these.",
                block=self.block.label,
            )
        _, digest, platform, t, running = _HEADER.unpack(head)
        if (digest, platform) != self._identity():
            here = bytes.fromhex(self.description.digest)
            found, expected = (d.hex()[:12] for d in (digest, here))
            raise FmuError(
                f"found the state of another FMU: SHA-256 {found}… on "
                f"{platform.rstrip(bytes(1)).decode()}, expected {expected}… on {native_platform()}. Run the FMU that "
                "was saved.",
                block=self.block.label,
            )
        return self._keep(self.call("reading a serialized state", "deserializeFMUState", rest), t, running)

    def _identity(self) -> tuple[bytes, bytes]:
        return bytes.fromhex(self.description.digest), native_platform().encode().ljust(24, b"\0")

    def _keep(self, handle: Any, t: float, running: bool) -> FmuState:
        self._final.value = False  # the FMU may be set back from now on
        self._handles[id(handle)] = handle
        return FmuState(self, handle, t, running)

    def _release(self, handle: Any) -> None:
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
        self._check_can("canGetAndSetFMUState", "restored", self.can_save)
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
                self._release(handle)
        super().close()
