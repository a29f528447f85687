"""Notes of what a compiler is busy with, for whoever waits for it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

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
def tell_build(note: str) -> Iterator[None]:
    """Tell whoever listens that something is compiled within the ``with`` statement."""
    listener = _LISTENER.get()
    if listener is None:
        yield
        return
    listener(note)
    try:
        yield
    finally:
        listener("")
