"""Saved states of an instance (FMI 2.0, 2.1.8; FMI 3.0, 2.2.6.4), and their bytes."""

from __future__ import annotations

import struct
import weakref
from collections.abc import Sequence
from typing import Any

from ...blocks.core import FmuError, explain_calls
from ..platform import native_platform
from .fmu_block import FmuBlock
from .running_fmu import RunningFmu


class SavingFmu(RunningFmu):
    """Instance whose states can be saved and restored, where the FMU offers that: `can_save`, `can_serialize`."""

    def __init__(self, block: FmuBlock, wired: Sequence[str]):
        super().__init__(block, wired)
        self._handles: dict[int, Any] = {}
        self.final = self.fmi.final  # noSetFMUStatePriorToCurrentPoint, until a state has been saved

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
        return self.keep(self.call("saving its state", self.fmi.save_state))

    def restore(self, state: FmuState) -> None:
        """Restore a saved state, earlier or later; this is allowed after an error, too.

        Raises
        ------
        FmuError
            If the state belongs to another instance, or has been freed.
        FmuRuntimeError
            If the FMU's function fails.
        """
        self._check_state(state)
        self.go_back(state)
        self.failed, self._running = False, state.running

    def go_back(self, state: FmuState) -> None:
        """Set the FMU back to its own state, and nothing else."""
        self.call("restoring its state", self.fmi.set_state, state.handle)

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
        data = self.call("serializing its state", self.fmi.serialize_state, state.handle)
        return _FORMAT.pack(self.description.digest, state.t, state.running, data=bytes(data))

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
        (t, running), rest = _FORMAT.unpack(data, self.description.digest, self.block.label)
        state = self.keep(self.call("reading a serialized state", self.fmi.deserialize_state, rest))
        state.t, state.running = t, running
        return state

    def keep(self, handle: Any) -> FmuState:
        """Return the saved state of a handle, as one of the present time."""
        self.final.value = False  # the FMU may be set back from now on
        self._handles[id(handle)] = handle
        return FmuState(self, handle, self.t, self._running)

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


@explain_calls
class FmuState:
    """Saved state of an `FmuInstance`: all of its memory at one time, and that time.

    It belongs to the instance that made it, and is freed with it, or when nothing refers to it any more.
    """

    def __init__(self, instance: SavingFmu, handle: Any, t: float, running: bool):
        self.instance, self.t, self.running = instance, t, running
        self.steps: object = None  # what `Step.memory` has returned
        self.handle = handle
        self._free = weakref.finalize(self, instance.release, handle)
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


class StateFormat:
    """Bytes of a state: what they are, the FMU's digest, this platform, some numbers, then the FMU's own.

    ``magic`` are eight bytes at their beginning; ``numbers`` are as `struct` describes them. ``kind`` and ``expected``
    say in messages what such bytes are.
    """

    def __init__(self, magic: bytes, numbers: str, kind: str, expected: str):
        self._head, self._magic = struct.Struct(f"<8s32s24s{numbers}"), magic
        self._kind, self._expected = kind, expected

    @property
    def size(self) -> int:
        """Number of bytes before the FMU's own."""
        return self._head.size

    def pack(self, digest: str, *numbers: float, data: bytes) -> bytes:
        """Return the bytes of a state of an FMU with a digest."""
        return self._head.pack(self._magic, *self._identify(digest), *numbers) + data

    def unpack(self, data: bytes, digest: str, label: str, *, least: int = 0) -> tuple[tuple[Any, ...], bytes]:
        """Return the numbers of a state, and the FMU's bytes, which are not less than so many."""
        if len(data) < self.size + least or not data.startswith(self._magic):
            raise FmuError(
                f"found {len(data)} bytes that are no {self._kind}; expected {self._expected}. Give these.", block=label
            )
        _, found, platform, *numbers = self._head.unpack(data[: self.size])
        if (found, platform) != self._identify(digest):
            raise FmuError(
                f"found the state of another FMU: SHA-256 {found.hex()[:12]}… on "
                f"{platform.rstrip(bytes(1)).decode()}, expected {digest[:12]}… on {native_platform()}. Run the FMU "
                "that was saved, with the fuse= of that run.",
                block=label,
            )
        return tuple(numbers), data[self.size :]

    @staticmethod
    def _identify(digest: str) -> tuple[bytes, bytes]:
        return bytes.fromhex(digest), native_platform().encode().ljust(24, b"\0")


_FORMAT = StateFormat(b"lw-fmu-1", "d?", "state of an FMU", "those of serialize()")
"""State in co-simulation: its time in s, and whether it ran."""
