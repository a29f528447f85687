"""Saved states of an instance (FMI 2.0, 2.1.8; FMI 3.0, 2.2.6.4), and their bytes."""

from __future__ import annotations

import struct
import weakref
from typing import Any

from ...blocks.core import FmuError, explain_calls
from ..platform import native_platform
from .loaded_fmu import LoadedFmu


class SavedStates:
    """States of an instance that are saved, restored, and turned into bytes, where the FMU offers that.

    Attributes
    ----------
    kept : dict of int to weakref.finalize
        Functions that free those that are not freed yet, by the identities of the FMU's handles.
    final : ctypes value
        Argument noSetFMUStatePriorToCurrentPoint of a step: true as long as no state has been saved.
    """

    def __init__(self, fmu: LoadedFmu):
        self._fmu = fmu
        self.kept: dict[int, weakref.finalize[..., FmuState]] = {}
        self.final = fmu.fmi.final

    def save(self) -> FmuState:
        """Save the present state."""
        about = self._fmu.description
        self._check_can(about.state_flags[0], "saved", about.can_save)
        return self.keep(self._fmu.call("saving its state", self._fmu.fmi.save_state))

    def keep(self, handle: Any) -> FmuState:
        """Return the saved state of a handle, as one of the present time."""
        self.final.value = False  # the FMU may be set back from now on
        return FmuState(self, self._fmu.setup.label, handle, self._fmu.t, self._fmu.is_running)

    def go_back(self, state: FmuState) -> None:
        """Set the FMU back to its own state, and nothing else."""
        self._fmu.ends_run = False
        self._fmu.call("restoring its state", self._fmu.fmi.set_state, state.handle)

    def restore(self, state: FmuState) -> None:
        """Restore a saved state, earlier or later; this is allowed after an error, too."""
        self._check_state(state)
        self.go_back(state)
        self._fmu.failed, self._fmu.is_running = False, state.running

    def serialize(self, state: FmuState | None) -> bytes:
        """Return a saved state, or the present one, as bytes."""
        about = self._fmu.description
        self._check_can(about.state_flags[1], "turned into bytes", about.can_serialize)
        if state is None:
            state = self.save()
        self._check_state(state)
        data = self._fmu.call("serializing its state", self._fmu.fmi.serialize_state, state.handle)
        return _FORMAT.pack(about.digest, state.t, state.running, data=bytes(data))

    def deserialize(self, data: bytes) -> FmuState:
        """Return a state of this instance, made from bytes."""
        about = self._fmu.description
        self._check_can(about.state_flags[1], "made from bytes", about.can_serialize)
        (t, running), rest = _FORMAT.unpack(data, about.digest, self._fmu.setup.label)
        state = self.keep(self._fmu.call("reading a serialized state", self._fmu.fmi.deserialize_state, rest))
        state.t, state.running = t, running
        return state

    def release(self, handle: Any) -> None:
        """Free the saved state of a handle."""
        del self.kept[id(handle)]
        self._fmu.free_state(handle)

    def close(self) -> None:
        """Free all that are left."""
        for free in [*self.kept.values()]:
            free()

    def _check_can(self, flag: str, action: str, can: bool) -> None:
        label = self._fmu.setup.label
        if not self._fmu.is_open:
            raise FmuError(f"its run is over, so no state can be {action}. Do it within the run.", block=label)
        if not can:
            raise FmuError(
                f"its state can't be {action}: {flag} is false in the FMU's description. Export it with that "
                "capability, or run again from the start.",
                block=label,
            )

    def _check_state(self, state: FmuState) -> None:
        about, label = self._fmu.description, self._fmu.setup.label
        self._check_can(about.state_flags[0], "restored", about.can_save)
        if state.owner is not self:
            raise FmuError(
                f"found a state of another instance, {state!r}. Carry it over: restore(deserialize(data)) with the "
                "data of that instance's serialize().",
                block=label,
            )
        if state.is_free:
            raise FmuError(f"found a state that has been freed, {state!r}. Keep it until it is restored.", block=label)


@explain_calls
class FmuState:
    """Saved state of an `FmuInstance`: all of its memory at one time, and that time.

    It belongs to the instance that made it, and is freed with it, or when nothing refers to it any more.
    """

    def __init__(self, owner: SavedStates, label: str, handle: Any, t: float, running: bool):
        self.owner, self.label, self.t, self.running = owner, label, t, running
        self.steps: object = None  # what `Step.memory` has returned
        self.handle = handle
        self._free = owner.kept[id(handle)] = weakref.finalize(self, owner.release, handle)
        self._free.atexit = False  # the end of the process frees the memory anyway

    @property
    def is_free(self) -> bool:
        """Whether the state has been freed, so that it can't be restored any more."""
        return not self._free.alive

    def free(self) -> None:
        """Free the state's memory in the FMU."""
        self._free()

    def __repr__(self) -> str:
        return f"FmuState({self.label}, t={self.t:.9g}{', freed' if self.is_free else ''})"


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
