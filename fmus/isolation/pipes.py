"""Sleeping for a byte in a pipe."""

from __future__ import annotations

import select
import time
from typing import Any


def make_poll(pipe: int) -> Any:
    """Return the system's object that waits for a pipe; None where there is none."""
    if not hasattr(select, "poll"):
        return None
    poll = select.poll()
    poll.register(pipe, select.POLLIN)
    return poll


def is_readable(poll: Any, pipe: int, seconds: float) -> bool:
    """Wait for some seconds at most, and return whether there is a byte in the pipe, or the pipe is closed."""
    if poll is not None:
        return bool(poll.poll(seconds * 1000))
    import _winapi  # not tried
    import msvcrt

    handle, end = msvcrt.get_osfhandle(pipe), time.monotonic() + seconds  # type: ignore[attr-defined]
    while True:
        try:
            if _winapi.PeekNamedPipe(handle, 0)[0]:  # type: ignore[attr-defined]
                return True
        except OSError:
            return True  # closed: reading says so
        if time.monotonic() >= end:
            return False
        time.sleep(0.0005)
