"""Notes of what a compiler is busy with, for whoever waits for it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from threading import Lock, Timer

LATE = 1.0
"""Time in s that a compiler takes before a terminal shows it; what is compiled was written before."""
_LISTENER: ContextVar[Callable[[str], None] | None] = ContextVar("loopwright_build_listener", default=None)


@contextmanager
def hear_builds(listener: Callable[[str], None]) -> Iterator[None]:
    """Tell a function what is compiled within the ``with`` statement, and "" when that is done."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


@contextmanager
def announce_build(note: str) -> Iterator[None]:
    """Tell whoever listens that something is compiled within the ``with`` statement; a terminal if nobody does."""
    listener = _LISTENER.get()
    if listener is None:
        with _write_to_terminal(note):
            yield
        return
    listener(note)
    try:
        yield
    finally:
        listener("")


@contextmanager
def _write_to_terminal(note: str) -> Iterator[None]:
    """Show a note on a terminal while something lasts, if that takes longer than `LATE`."""
    out = sys.stderr
    if out is None or not out.isatty():
        yield
        return
    lock, shown, over = Lock(), False, False

    def show() -> None:
        nonlocal shown
        with lock:
            if not over:
                out.write(f"{note} …")
                out.flush()
                shown = True

    timer = Timer(LATE, show)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        with lock:
            over = True
            if shown:
                out.write(f"\r{' ' * (len(note) + 2)}\r")
                out.flush()
