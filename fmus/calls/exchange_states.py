"""State of an FMU in model exchange as bytes: what it is of, time, next time event, inputs, and the FMU's own bytes."""

from __future__ import annotations

import ctypes
import struct
from typing import Any

import numpy as np

from ...blocks.core import FmuError
from ..archive import ExchangeInfo, FmuDescription, FmuVariable
from ..platform import native_platform
from .loaded_library import LoadedFmu

_HEADER = struct.Struct("<8s32s24sdd")  # magic, FMU's digest, platform, time, next time event
_MAGIC = b"lw-fmu-x"


def _identity(description: FmuDescription) -> tuple[bytes, bytes]:
    return bytes.fromhex(description.digest), native_platform().encode().ljust(24, b"\0")


def pack_state(description: FmuDescription, t: float, next_time: float, u: np.ndarray, data: bytes) -> bytes:
    """Return a state as bytes.

    Parameters
    ----------
    t, next_time : float
        Time of the instance, and of its next time event, in s.
    u : ndarray
        All inputs.
    data : bytes
        The FMU's serialized state.
    """
    return _HEADER.pack(_MAGIC, *_identity(description), t, next_time) + u.astype("<f8").tobytes() + data


def unpack_state(description: FmuDescription, data: bytes, width: int) -> tuple[float, float, np.ndarray, bytes]:
    """Return time, next time event, inputs and the FMU's bytes of a state; ``width`` is the number of inputs.

    Raises
    ------
    FmuError
        If the bytes are no state of this FMU in model exchange on this platform.
    """
    n = _HEADER.size + 8 * width
    if len(data) < n or not data.startswith(_MAGIC):
        raise FmuError(
            f"found {len(data)} bytes that are no state of an FMU in model exchange; expected those of a run with the "
            "same interface. Give these."
        )
    _, digest, platform, t, next_time = _HEADER.unpack(data[: _HEADER.size])
    here = _identity(description)
    if (digest, platform) != here:
        raise FmuError(
            f"found the state of another FMU: SHA-256 {digest.hex()[:12]}… on "
            f"{platform.rstrip(bytes(1)).decode()}, expected {here[0].hex()[:12]}… on {native_platform()}. Run the "
            "FMU that was saved, with the fuse= of that run."
        )
    return t, next_time, np.frombuffer(data[_HEADER.size : n], "<f8").copy(), data[n:]


class SavedExchange(LoadedFmu):
    """Instance in model exchange whose complete state can be saved, where the FMU can serialize it."""

    about: ExchangeInfo
    next_time: float
    ends_run: bool
    _ports: dict[str, FmuVariable]
    _u: np.ndarray
    _time: ctypes.c_double
    _final: bool

    def operating_point(self) -> dict[str, Any]:
        """Return the present ``t``, ``state`` and ``inputs``, for `Fmu.linear_model`."""
        about = self.description

        def read(variable: FmuVariable) -> np.ndarray:
            return self.read_variables([variable]).reshape(variable.shape)

        state = {name: read(about.find(name)) for name in (*about.states, *about.discrete_states)}
        return {"t": self.t, "state": state, "inputs": {port: read(v) for port, v in self._ports.items()}}

    @property
    def can_serialize(self) -> bool:
        """Whether its state can be turned into bytes."""
        return self.about.can_serialize

    def serialize(self) -> bytes:
        """Return its complete state.

        Raises
        ------
        FmuError
            If the FMU can't serialize its state (`can_serialize`).
        FmuRuntimeError
            If the FMU's function fails.
        """
        self._check_can()
        self._final = False
        handle = self.call("saving its state", self.fmi.save_state)
        try:
            data = self.call("serializing its state", self.fmi.serialize_state, handle)
        finally:
            self.free_state(handle)
        return pack_state(self.description, self.t, self.next_time, self._u, bytes(data))

    def restore_bytes(self, data: bytes) -> None:
        """Go to a state that `serialize` has returned.

        Raises
        ------
        FmuError
            If the bytes are no state of this FMU in model exchange on this platform.
        FmuRuntimeError
            If the FMU's function fails.
        """
        self._check_can()
        try:
            t, next_time, u, rest = unpack_state(self.description, data, sum(v.size for v in self._ports.values()))
        except FmuError as error:
            raise error.at(block=self.block.label) from None
        handle = self.call("reading a serialized state", self.fmi.deserialize_state, rest)
        try:
            self.call("restoring its state", self.fmi.set_state, handle)
        finally:
            self.free_state(handle)
        self.failed, self._running, self._final, self.ends_run = False, True, False, False
        self._u, self.next_time, self._time.value = u, next_time, t

    def _check_can(self) -> None:
        if self.can_serialize:
            return
        flag = self.description.state_flags[1 if self.about.can_save else 0]
        raise FmuError(
            f"its state can't be turned into bytes: {flag} is false for model exchange in the FMU's description. "
            "Export it with that capability, or run again from the start.",
            block=self.block.label,
        )
