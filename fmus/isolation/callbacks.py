"""Functions that an FMU calls: its log, the C library's memory, inputs within a step.

They are the same in this process and in a child, so this imports the standard library only.

A log message of FMI 2.0 is a printf format and its arguments (FMI 2.0, 2.1.5), which ctypes has no types for. On Linux,
arguments after the fixed ones are in the registers and on the stack where further fixed ones would be. So the callback
declares some, integers and floating-point numbers, and the format says which of them are there. A format that asks for
more than was given shows nonsense or a question mark, but reads no invalid memory and writes none.
"""

from __future__ import annotations

import ctypes
import os
import platform
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any


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


# --- messages ---------------------------------------------------------------------------------------------------------


_WORDS, _NUMBERS = 9, 8
_HAS_ARGUMENTS = sys.platform == "linux" and platform.machine().lower() in ("x86_64", "amd64", "aarch64", "arm64")
Logger = ctypes.CFUNCTYPE(
    None,
    *(ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_char_p),
    *((ctypes.c_int64,) * _WORDS + (ctypes.c_double,) * _NUMBERS if _HAS_ARGUMENTS else ()),
)
"""Type of the callback: environment, instance, status, category, format, and the arguments of the format."""

_DIRECTIVE = re.compile(
    r"%(?:(?P<percent>%)|(?P<flags>[-+ #0]*)(?P<width>\*|\d+)?(?:\.(?P<precision>\*|\d+)?)?"
    r"(?P<length>hh|h|ll|l|z|j|t)?(?P<kind>[diouxXcsfFeEgGaAp]))"
)
_LONGEST, _WIDEST = 2000, 200


def format_message(text: bytes, arguments: Sequence[Any]) -> str:
    """Return the text of a message.

    Parameters
    ----------
    text : bytes
        The format.
    arguments : sequence
        Nine integers and eight floating-point numbers that may be its arguments; empty if they aren't known.

    Examples
    --------
    >>> format_message(b"100 %% of %d", [7] * 9 + [0.5] * 8)
    '100 % of 7'
    """
    words, numbers = iter(arguments[:_WORDS]), iter(arguments[_WORDS:])
    return _DIRECTIVE.sub(lambda match: _convert(match, words, numbers), text.decode(errors="replace"))


def _convert(match: re.Match[str], words: Iterator[int], numbers: Iterator[float]) -> str:
    if match["percent"]:
        return "%"
    try:
        width, precision = (_read_size(match[name], words) for name in ("width", "precision"))
        flags, kind = match["flags"], match["kind"]
        dot = f".{precision}" if precision else ""
        if kind in "fFeEgG":
            return f"%{flags}{width}{dot}{kind}" % next(numbers)
        if kind in "aA":
            return next(numbers).hex()
        word = next(words)
        if kind == "s":
            return f"%{flags}{width}{dot}s" % _read_text(word)
        if kind == "p":
            return hex(word)
        if kind == "c":
            return chr(word & 0xFF)
        bits = {"hh": 8, "h": 16, None: 32}.get(match["length"], 64)
        word &= (1 << bits) - 1
        if kind in "di" and word >> (bits - 1):
            word -= 1 << bits
        return f"%{flags}{width}{dot}{'d' if kind in 'diu' else kind}" % word
    except (StopIteration, ValueError, TypeError, OverflowError):
        return match[0]


def _read_size(text: str | None, words: Iterator[int]) -> str:
    """Return a width or a precision, which the format or an argument gives; a wild one is cut."""
    if not text:
        return text or ""
    number = next(words) & 0xFFFFFFFF if text == "*" else int(text)
    return str(min(number, _WIDEST))


def _read_text(address: int) -> str:
    """Return the text at an address, "?" if there is no memory: the system reads it, which can refuse."""
    if not address:
        return "(null)"
    reader, writer = os.pipe()
    try:
        write = ctypes.CDLL(None, use_errno=True).write
        write.restype, write.argtypes = ctypes.c_ssize_t, (ctypes.c_int, ctypes.c_void_p, ctypes.c_size_t)
        found = b""
        address &= (1 << 64) - 1
        while len(found) < _LONGEST and b"\0" not in found:
            size = 256 - address % 256  # never beyond a page
            got = write(writer, address, size)
            if got <= 0:
                return found.decode(errors="replace") or "?"
            found += os.read(reader, got)
            address += got
        return found.partition(b"\0")[0].decode(errors="replace")
    finally:
        os.close(reader)
        os.close(writer)
