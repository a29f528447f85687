"""Functions that an FMU calls: its log, the C library's memory, inputs within a step.

They are the same in this process and in a child, so this imports the standard library only.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable, Sequence
from typing import Any

from .printf import Logger, format_message


def log_and_memory(log: Callable[[int, str], None]) -> tuple[Any, Any]:
    """Return the callbacks before FMI 3.0 as five pointers: log, calloc, free, and two that are none.

    The second value is the log as C calls it, which must live as long as the FMU. Messages without a status are not
    passed on.
    """

    def message(environment: Any, name: Any, status: int, category: Any, text: bytes | None, *arguments: Any) -> None:
        if status:
            log(status, format_message(text or b"", arguments))

    logger = Logger(message)
    library = ctypes.CDLL(None) if sys.platform != "win32" else ctypes.cdll.msvcrt
    functions = logger, library.calloc, library.free
    pointers = (ctypes.cast(function, ctypes.c_void_p).value for function in functions)
    return (ctypes.c_void_p * 5)(*pointers, None, None), logger


class InputLines:
    """Inputs of type Float64 that follow straight lines within a step (FMI 3.0, 4.2.2).

    ``line`` is a C array of numbers: start in s, worst status of setting them, values at the start, slopes.
    ``set_values`` is the FMU's function fmi3SetFloat64, ``instance`` its first argument.
    """

    def __init__(self, line: Any, references: Sequence[int], instance: ctypes.c_void_p, set_values: Any):
        self._line, self._instance, self._set = line, instance, set_values
        self._references = (ctypes.c_uint * len(references))(*references)
        self._values = (ctypes.c_double * (len(line) // 2 - 1))()

    def set_at(self, t: float) -> None:
        """Set the inputs at a time in s."""
        line, values = self._line, self._values
        n, size = len(values), ctypes.c_size_t
        for i in range(n):
            values[i] = line[2 + i] + line[2 + n + i] * (t - line[0])
        status = self._set(self._instance, self._references, size(len(self._references)), values, size(n))
        line[1] = max(line[1], status & 0xFFFFFFFF)
