"""Functions of events in model exchange, and where their answers are."""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

from ...blocks.core import FmuRuntimeError
from .bound_calls import Call


class EventUpdate(NamedTuple):
    """Answer of a round of the event iteration."""

    again: bool
    """Whether another round is needed."""
    terminate: bool
    nominals_changed: bool
    next_time: float
    """Time of the next time event in s, infinite without one."""


class AnswersAt(NamedTuple):
    """Addresses of the answers of ``update`` and ``complete``: flags of ``width`` bytes each, and a time in s."""

    width: int
    again: int
    terminate: int
    nominals: int
    defined: int
    next_time: int
    wants: int
    ends: int
    again_where: bool = True  # value of the flag ``again`` with which another round is wanted

    def updated(self) -> EventUpdate:
        """Return the answer of the last ``update``."""
        next_time = ctypes.c_double.from_address(self.next_time).value if self._flag(self.defined) else math.inf
        again = self._flag(self.again) == self.again_where
        return EventUpdate(again, self._flag(self.terminate), self._flag(self.nominals), next_time)

    def completed(self) -> tuple[bool, bool]:
        """Return the answer of the last ``complete``: whether Event Mode is wanted, and the end of the run."""
        return self._flag(self.wants), self._flag(self.ends)

    def _flag(self, address: int) -> bool:
        return any(ctypes.string_at(address, self.width))


@dataclass(frozen=True)
class EventCalls:
    """Functions of events in model exchange with their arguments, to be bound, and where their answers are."""

    enter: Call | None  # None without modes, as in FMI 1.0
    update: Call
    leave: Call | None
    complete: Call
    """It reports a step of the solver that was accepted."""
    final: Any
    """Argument of ``complete``: whether no earlier state will be restored, a C value that can be changed."""
    answers: AnswersAt
    kept: Any
    """Memory of the answers."""


def addresses_in(info: ctypes.Structure, *names: str) -> list[int]:
    """Return the addresses of fields of a structure."""
    return [ctypes.addressof(info) + getattr(type(info), name).offset for name in names]


def check_next_time(label: str, found: float, t: float) -> float:
    """Return the time of a next event in s, as an event at time t has set it; refuse one that is no number."""
    if math.isnan(found):
        raise FmuRuntimeError(
            f"the event at t = {t:.9g} s sets the time of its next one (nextEventTime) to NaN; expected a time, or "
            "nextEventTimeDefined = false. Look up its inputs and parameters there, or report it to its makers.",
            block=label,
            t=t,
        )
    return found
