"""The change from the virtual machine to generated code within a run: when it is prepared, and when it is made."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter
from typing import TYPE_CHECKING, Any

from .view import Position

if TYPE_CHECKING:
    from ..compiled import BackgroundCode

_REPORTED: list[Exception] = []  # the failure that this process has reported
_PATIENCE = 0.02  # s of interpreted ticks before which nobody thinks of a compiler


class ChangeOver:
    """Watches an interpreted run, and has C code generated for it if it takes long."""

    def __init__(self, position: Position):
        self._position, self._possible = position, True
        self._later: BackgroundCode | None = None
        self._spent = 0.0

    def watch(
        self,
        last: int,
        progress: Callable[[float], Any],
        make: Callable[[], BackgroundCode],
        take_over: Callable[[], None],  # called once the code is there
    ) -> Callable[[float], Any]:
        """Return a ``progress`` for an interpreted run from here up to a tick, which has the code made in time."""
        started, before, first, end = perf_counter(), self._spent, self._position.t, self._position.time_of(last)

        def arrive(t: float) -> None:
            spent = perf_counter() - started
            self._spent = before + spent
            if self._possible and self._spent > _PATIENCE and t > first:
                self._look(make, spent * (end - t) / (t - first))
                if self.code is not None:
                    self._possible = False
                    take_over()
            progress(t)

        return arrive

    def _look(self, make: Callable[[], BackgroundCode], rest: float) -> None:
        if self._later is None:
            self._later = make()
        self._later.look(self._spent, rest)

    def report_failure(self) -> tuple[str, ...]:
        """Return a message that there is no compiler, or one that fails; once in a process."""
        failure = None if self._later is None else self._later.failure
        if failure is None or _REPORTED:
            return ()
        _REPORTED.append(failure)
        text = "Interpreted, though the run is long enough for C: {}. compile=False asks for no compiler."
        return (text.format(str(failure).rstrip(".")),)

    @property
    def code(self) -> Any:
        """The code; None while there is none."""
        return self._later.code if self._later is not None and self._later.ready else None
