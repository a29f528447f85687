"""Reasons for the end of a child: what its exit status, its last words and its memory say."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from ...blocks.core import FmuEnd
from .shared_memory import MEMORY, NO_ROOM, OUTPUT

_BY_US = -int(getattr(signal, "SIGKILL", signal.SIGTERM))
_NEARLY = 0.8  # part of the memory that counts as all of it


def read_end(
    status: int | None, noted: int, error: Exception | None, peak: int, memory: int, output: int
) -> tuple[FmuEnd, str]:
    """Return cause and text for the way in which the process has ended."""
    if noted == MEMORY:
        return FmuEnd.MEMORY, f"it took more memory than {memory / 1e6:.6g} MB; its process was ended"
    if noted == NO_ROOM:
        limit = f"{memory / 1e6:.6g} MB"
        return FmuEnd.MEMORY, f"its process, which takes some 20 MB by itself, can't start within the limit of {limit}"
    if noted == OUTPUT:
        return FmuEnd.OUTPUT, f"it wrote more than {output / 1e6:.6g} MB; its process was ended"
    if status is None or (status == _BY_US and error is not None):
        return FmuEnd.LOST, f"its process does not answer any more ({error or 'its pipe is closed'})"
    if status < 0:
        try:
            name = signal.Signals(-status).name
        except ValueError:
            name = f"signal {-status}"
        more = f": {text}" if (text := signal.strsignal(-status)) else ""
        if peak > _NEARLY * memory:  # the system gave it no more, which few libraries bear
            used = f"{peak / 1e6:.6g} of {memory / 1e6:.6g} MB"
            return FmuEnd.MEMORY, f"its process crashed ({name}{more}) when its memory was used up ({used})"
        if status == _BY_US:
            return FmuEnd.KILLED, f"its process was killed ({name}{more})"
        return FmuEnd.CRASH, f"its process crashed ({name}{more})"
    if os.name == "nt" and status >= 0xC0000000:
        return FmuEnd.CRASH, f"its process crashed (0x{status:08X})"
    return FmuEnd.EXIT, f"it ended its process with exit status {status}"


def describe_memory(pid: int | None, limit: int) -> str:
    """Return a sentence if a process has nearly as much memory as it may have; it is known on Linux."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
        used = 1024 * int(status.split("VmData:")[1].split()[0])
    except (OSError, ValueError, IndexError):
        return ""
    if used < _NEARLY * limit:
        return ""
    return (
        f" Its process has {used / 1e6:.6g} of {limit / 1e6:.6g} MB of memory, so that it may have got no more: raise "
        "the limit by isolate=Isolation(memory=…)."
    )
