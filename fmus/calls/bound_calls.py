"""C functions that are bound once to their arguments, and their statuses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

Call = tuple[Callable[..., int], tuple[Any, ...]]
"""A C function, and its arguments."""
STATUS = ("OK", "warning", "discard", "error", "fatal", "pending")
WARNING, DISCARD, ERROR, FATAL, PENDING = range(1, 6)
"""Statuses of FMI's functions (FMI 2.0, 2.1.3; FMI 3.0, 2.2.3)."""


class BoundCalls:
    """C functions with their arguments, bound once and called one after the other.

    Parameters
    ----------
    calls : sequence of (function, arguments)
        Functions of the library, with arguments that are C values; their memory is that of `FmiCalls.allocate` and
        `FmiCalls.variable`, or doesn't change.
    """

    failed = 0
    """Place of the call that has failed last."""

    def __init__(self, calls: Sequence[Call]):
        self._calls = tuple(calls)

    def run(self) -> int:
        """Call the functions up to the first that fails; return its status, else 1 after a warning, else 0."""
        worst = 0
        for place, (function, arguments) in enumerate(self._calls):
            status = function(*arguments)
            if not 0 <= status <= WARNING:
                self.failed = place
                return status
            worst |= status
        return worst

    def start(self) -> None:
        """Begin to run, if that can go on by itself; `finish` ends it."""

    def finish(self) -> int:
        """Return the status of what `start` has begun."""
        return self.run()
