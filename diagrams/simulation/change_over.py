"""The change from interpreted ticks to C within a run: when it is prepared, and when it is made."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from time import perf_counter
from typing import TYPE_CHECKING, Any

from ..coupling import Plant, runs_apart
from .continuous import Continuous
from .view import Position

if TYPE_CHECKING:
    from .compiled_hybrid import HybridTicks
    from .compiled_ticks import LaterCode

_PATIENCE = 0.02  # s of interpreted ticks before which nobody thinks of a compiler
_PATIENCE_OF_WORK = 0.05  # s of counted work before which it says nothing about the rest
_STEP, _EVENT, _OPERATION = 1e-4, 3e-4, 6e-8  # s of a solver's step, of an event, and of an operation in a step
_LANDING, _SAMPLE = 6e-5, 5e-6  # s, at least, of a tick at which a solver begins anew, and of a sample
_ROUND_TRIPS = 1e-4  # s more, of a step or a tick, for each FMU in model exchange in a process of its own
_START, _COMPILING, _LARGE = 0.4, 1e-3, 2000  # s to begin with C, and to compile one of at most so many operations


class ChangeOver:
    """Watches an interpreted run, and has C code generated for it if it takes long.

    Parameters
    ----------
    position : Position
        The instant that the run has reached.
    make : callable
        Returns the code that is to be made; None where it can't be had.
    """

    def __init__(self, position: Position, make: Callable[[], LaterCode[Any] | None]):
        self._position, self._make, self._possible = position, make, True
        self._later: LaterCode[Any] | None = None
        self._spent = 0.0

    def watch(
        self, last: int, progress: Callable[[float], Any], note_due: Callable[[], None]
    ) -> Callable[[float], Any]:
        """Return a ``progress`` for an interpreted run from here up to a tick, which has the code made in time.

        It calls ``note_due`` once the code is there: nothing is looked at in every tick.
        """
        started, before, first, end = perf_counter(), self._spent, self._position.t, self._position.time_of(last)

        def tell(t: float) -> None:
            spent = perf_counter() - started
            self._spent = before + spent
            if self._possible and self._spent > _PATIENCE and t > first:
                self._look(spent * (end - t) / (t - first))
                if self.code is not None:
                    self._possible = False
                    note_due()
            progress(t)

        return tell

    def _look(self, rest: float) -> None:
        if self._later is None:
            self._later = self._make()
        if self._later is None:
            self._possible = False
        else:
            self._later.background.look(self._spent, rest)

    def tell_failure(self) -> tuple[str, ...]:
        """Return a message that there is no compiler, or one that fails; once in a process."""
        return () if self._later is None else self._later.tell_failure()

    @property
    def code(self) -> Any:
        """The code; None while there is none."""
        return self._later.background.code if self._later is not None and self._later.background.ready else None


class HybridChange:
    """Decides when a run with continuous states goes on in C under "auto".

    Values of both forms agree within the tolerances, not in every bit. So the decision depends on no clock and no
    cache: it counts the work of the run, in seconds of a usual machine, and the same run changes at the same instant
    wherever it runs.

    Parameters
    ----------
    continuous : Continuous
        The run's solver and events.
    position : Position
        The instant that the run has reached.
    plants : mapping of str to Plant
        The plants by path; it may be filled later.
    make : callable
        Returns the ticks in C; None where they can't be had.
    every : bool
        Visit every tick, not only those at which a subsystem acts.

    Attributes
    ----------
    ticks : HybridTicks or None
        The ticks in C, once they are wanted.
    """

    def __init__(
        self,
        continuous: Continuous,
        position: Position,
        plants: Mapping[str, Plant],
        make: Callable[[], HybridTicks | None],
        every: bool,
    ):
        self._continuous, self._position, self._plants, self._every = continuous, position, plants, every
        self._make, self._possible = make, True
        flat = continuous.flat
        self._limit = _START + _COMPILING * min(flat.operations, _LARGE)
        self._step = _STEP + _OPERATION * flat.operations
        self._work = 0.0
        self.ticks: HybridTicks | None = None

    def begin_anew(self) -> None:
        """Count the work of another run."""
        self._work, self.ticks = 0.0, None

    def is_due(self, last: int) -> bool:
        """Whether the ticks up to one are so many that C begins with them at once."""
        flat, count = self._continuous.flat, last - self._position.tick
        landed = count if self._every and (self._continuous.fixed or self._plants) else 0
        landed = max(landed, sum(count // clock.every for clock in flat.distinct))
        work = (_LANDING + self._round_trips) * min(landed, count) + _SAMPLE * count
        return self._possible and work > self._limit and self._begin(last)

    @property
    def _round_trips(self) -> float:
        blocks = self._continuous.exchanged
        return 0.0 if blocks is None else _ROUND_TRIPS * sum(map(runs_apart, blocks.blocks.values()))

    def watch(self, last: int, note_due: Callable[[], None]) -> Callable[[float, bool], bool] | None:
        """Return the `Continuous.watch` of interpreted steps up to a tick, which counts their work.

        It has the run paused where C takes over; beside plants, and where each step ends at a tick, it calls
        ``note_due``, and C begins at the next tick.
        """
        if not self._possible:
            return None
        position, before, first = self._position, self._work, self._position.t
        end, step = position.time_of(last), self._step + self._round_trips

        def tell(t: float, fires: bool) -> bool:
            self._work += step + (_EVENT if fires else 0.0)
            if self._work < _PATIENCE_OF_WORK or t >= end or not self._possible or self.ticks is not None:
                return False
            rest = (self._work - before) * (end - t) / (t - first)
            if max(self._work, rest) < self._limit or not self._begin(last):
                return False
            note_due()
            return not self._plants

        return tell

    def _begin(self, last: int) -> bool:
        self.ticks = self._make()
        if self.ticks is not None and not self.ticks.reaches(last):
            self.ticks = None
        self._possible = self.ticks is not None
        return self._possible
