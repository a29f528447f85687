"""State of this process that a library can change for all: working folder, rounding mode, floating-point traps."""

from __future__ import annotations

import ctypes
import os
import platform
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

_CONTROLS = {"x86_64": ((0, 2), (28, 32)), "aarch64": ((0, 4),)}
"""Bytes of C's ``fenv_t`` that hold rounding modes and traps, by the machine; glibc's layout."""
_FLAGS = 0x3F
"""Bits of the last of them on x86_64 that tell past exceptions, which are no modes."""
FOLDER = threading.RLock()
"""Held while a library is loaded, which takes place in its own folder: relative paths then lead elsewhere."""


class _FloatingPoint:
    """Rounding modes and traps of this thread, read and set by the C library."""

    def __init__(self) -> None:
        self.places = _CONTROLS.get(platform.machine().lower(), ()) if sys.platform == "linux" else ()
        library = ctypes.CDLL("libm.so.6") if self.places else None
        self.get: Callable[[Any], int] = getattr(library, "fegetenv", lambda at: 0)
        self.set: Callable[[Any], int] = getattr(library, "fesetenv", lambda at: 0)

    def views(self, environment: Any) -> list[Any]:
        """Return views of the modes in a ``fenv_t``, as C integers."""
        kinds = {2: ctypes.c_uint16, 4: ctypes.c_uint32}
        return [kinds[stop - start].from_buffer(environment, start) for start, stop in self.places]

    @staticmethod
    def modes(views: list[Any]) -> tuple[int, ...]:
        """Return the modes that views show."""
        if len(views) == 2:
            return views[0].value, views[1].value & ~_FLAGS
        return tuple(view.value for view in views)


_floating_point: _FloatingPoint | None = None


def _modes() -> _FloatingPoint:
    global _floating_point  # noqa: PLW0603 (loaded at the first call: importing loads nothing)
    if _floating_point is None:
        _floating_point = _FloatingPoint()
    return _floating_point


class HostState:
    """State at the start of a ``with`` statement; its end sets it back, and reports once each thing that was changed.

    One within another keeps the state of the outer one. Rounding modes and traps are kept on Linux alone. There
    `settle` sets them back after each call, to what they were at the last such start, so that nothing is computed in
    those of a library.
    """

    def __init__(self, report: Callable[[str], None]):
        self._report = report
        self._floating_point = _modes()
        self._numbers, self._now = ctypes.create_string_buffer(64), ctypes.create_string_buffer(64)
        self._views, self._views_now = (self._floating_point.views(found) for found in (self._numbers, self._now))
        self._keep_modes()
        self._noted: set[str] = set()
        self._folder, self._depth = "", 0

    def __enter__(self) -> HostState:
        self._depth += 1
        if self._depth > 1:
            return self
        self._folder = ""
        with suppress(OSError):  # a folder that has been removed
            self._folder = os.getcwd()
        self._keep_modes()
        return self

    def _keep_modes(self) -> None:
        self._floating_point.get(self._numbers)
        self._kept = self._floating_point.modes(self._views)

    def settle(self, status: Any, *_: object) -> Any:
        """Set rounding mode and traps back after a call, and return its result: what ctypes calls ``errcheck``."""
        numbers = self._floating_point
        numbers.get(self._now)
        if numbers.modes(self._views_now) != self._kept:
            numbers.set(self._numbers)
            self.note_modes()
        return status

    def __exit__(self, *error: object) -> None:
        if self._depth == 1:
            self.settle(None)
        self._depth -= 1
        if self._depth:
            return
        folder = ""
        with suppress(OSError):
            folder = os.getcwd()
        if folder != self._folder and self._folder:
            with suppress(OSError):
                os.chdir(self._folder)
            self._note("the working folder")

    def note_modes(self) -> None:
        """Say that rounding mode or traps were changed, and set back."""
        self._note("the rounding mode or the traps of floating-point numbers")

    def _note(self, change: str) -> None:
        if change not in self._noted:
            self._noted.add(change)
            self._report(f"the FMU has changed {change} of this process; it was set back")
