"""A saved state of an instance, and what its steps remember beside it."""

from __future__ import annotations

import math
import struct
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ...blocks.core import FmuError, explain_calls
from ..archive import OtherVariable
from ..platform import native_platform

_HEADER = struct.Struct("<8s32s24sd?")  # of a serialized state: magic, FMU's digest, platform, time, running
_MAGIC = b"lw-fmu-1"


class Saver(Protocol):
    """Instance that a saved state belongs to."""

    @property
    def block(self) -> Any:
        """The block."""

    @property
    def release(self) -> Callable[[Any], None]:
        """Frees the state of a handle."""


@dataclass
class Clock:
    """Input clock that ticks at times known ahead; infinite ones never come."""

    variable: OtherVariable
    interval: float = math.inf
    next: float = math.inf
    count: int = 0
    origin: float = 0.0

    def start(self, t: float, interval: float, shift: float) -> None:
        """Let it tick at t + shift, and then every interval, in s."""
        self.interval, self.origin, self.count = interval, t + shift, 0
        self.next = self.origin

    def tick(self) -> None:
        """Go on to the next tick."""
        if self.variable.is_periodic:
            self.count += 1
            self.next = self.origin + self.count * self.interval
        else:
            self.next = math.inf  # until the FMU says it anew


@dataclass(frozen=True)
class StepMemory:
    """Memory of the steps beside the FMU's own state: next events, the inputs of the step before, clocks."""

    next_event: float
    last: np.ndarray
    added: float
    fresh: bool
    clocks: tuple[tuple[float, float, int, float], ...]
    clocked: tuple[np.ndarray, ...]
    jumping: np.ndarray


@explain_calls
class FmuState:
    """Saved state of an `FmuInstance`: all of its memory at one time, and that time.

    It belongs to the instance that made it, and is freed with it, or when nothing refers to it any more.
    """

    def __init__(self, instance: Saver, handle: Any, t: float, running: bool, steps: StepMemory | None = None):
        self.instance, self.t, self.running, self.steps = instance, t, running, steps
        self._handle = handle
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


def pack_state(digest: str, t: float, running: bool, data: bytes) -> bytes:
    """Return the bytes of a state of an FMU, with the FMU's digest, this platform and its time in s before them."""
    return _HEADER.pack(_MAGIC, *_identify(digest), t, running) + data


def unpack_state(data: bytes, digest: str, label: str) -> tuple[float, bool, bytes]:
    """Return the time in s of a state, whether it ran, and the FMU's bytes of it.

    Raises
    ------
    FmuError
        If the bytes are no state of the FMU with this digest on this platform; ``label`` names its block.
    """
    head, rest = data[: _HEADER.size], data[_HEADER.size :]
    if len(head) < _HEADER.size or not head.startswith(_MAGIC):
        raise FmuError(
            f"found {len(data)} bytes that are no state of an FMU; expected those of serialize(). Give these.",
            block=label,
        )
    _, found, platform, t, running = _HEADER.unpack(head)
    if (found, platform) != _identify(digest):
        raise FmuError(
            f"found the state of another FMU: SHA-256 {found.hex()[:12]}… on {platform.rstrip(bytes(1)).decode()}, "
            f"expected {digest[:12]}… on {native_platform()}. Run the FMU that was saved, with "
            "the fuse= of that run.",
            block=label,
        )
    return t, running, rest


def _identify(digest: str) -> tuple[bytes, bytes]:
    return bytes.fromhex(digest), native_platform().encode().ljust(24, b"\0")
