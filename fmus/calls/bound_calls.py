"""C functions that are bound to their arguments once, and called one after the other; statuses of FMI."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from ..isolation import ChildRequest

Call = tuple[Callable[..., int], tuple[Any, ...]]
"""A C function, and its arguments."""
STATUS = ("OK", "warning", "discard", "error", "fatal", "pending")
WARNING, DISCARD, ERROR, FATAL, PENDING = range(1, 6)
"""Statuses of FMI's functions (FMI 2.0, 2.1.3; FMI 3.0, 2.2.3)."""


class BoundCalls:
    """C functions with their arguments, bound once and called one after the other.

    Arguments are C values; their memory is that of `FmiCalls.allocate` and `FmiCalls.variable`, or doesn't change.
    """

    failed = 0
    """Place of the call that has failed last."""
    warned = 0
    """Bits of the places of the calls that gave a warning in the last run, the last bit for all behind it."""

    def __init__(self, calls: Sequence[Call]):
        self.calls = tuple(calls)
        self._numbered = tuple((place, function, arguments) for place, (function, arguments) in enumerate(calls))

    def run(self) -> int:
        """Call the functions up to the first that fails; return its status, else 1 after a warning, else 0."""
        for place, function, arguments in self._numbered:
            if status := function(*arguments):
                return self._run_on(place, status)
        return 0

    def _run_on(self, first: int, status: int) -> int:
        """Continue from a place whose call has returned a status, as `run` does."""
        worst = self.warned = 0
        for place, function, arguments in self._numbered[first:]:
            status = status if place == first else function(*arguments)
            if status > WARNING:
                self.failed = place
                return status
            if status:
                worst, self.warned = status, self.warned | bit_of(place)
        return worst

    @property
    def request(self) -> ChildRequest | None:
        """The calls as a request to another process; None where they run in this one, or C can't ask for them."""
        return None

    def warned_places(self) -> list[int]:
        """Return the places of the calls that gave a warning, where `run` has returned 1."""
        return [place for place in range(len(self.calls)) if self.warned & bit_of(place)]

    def start(self) -> None:
        """Begin to run, if that can continue by itself; `finish` ends it."""

    def finish(self) -> int:
        """Return the status of what `start` has begun."""
        return self.run()


def bit_of(place: int) -> int:
    """Return the bit of a place; the last one of a word is for all places behind it."""
    return 1 << min(place, 62)
