"""State of an FMU in model exchange as bytes: what it is of, time, next time event, inputs, and the FMU's own bytes."""

from __future__ import annotations

import struct

import numpy as np

from ...blocks.core import FmuError
from ..archive import FmuDescription
from ..platform import native_platform

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
            "FMU that was saved."
        )
    return t, next_time, np.frombuffer(data[_HEADER.size : n], "<f8").copy(), data[n:]
