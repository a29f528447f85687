"""The change from interpreted ticks to C within a run: when it is prepared, and when it is made."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from time import perf_counter
from typing import TYPE_CHECKING, Any

from ..coupling import Plant, PlantSteps
from .view import Position
from .workspace import Workspace

if TYPE_CHECKING:
    from .compiled_ticks import CompiledTicks, LaterTicks

_PATIENCE = 0.02  # s of interpreted ticks before which nobody thinks of a compiler


class ChangeOver:
    """Watches interpreted ticks, and has C code made for them if they take long.

    Parameters
    ----------
    workspace : Workspace
        The run's numbers.
    position : Position
        The instant that the run has reached.
    plants : mapping of str to Plant
        The plants by path; it may be filled later.
    steps : PlantSteps
        Their steps.
    stops : sequence of int
        Entries of the log that end the run where they are true.
    every : bool
        Visit every tick, not only those at which a subsystem acts.
    plain : bool
        Whether nothing but the plants' steps happens between ticks.
    """

    def __init__(
        self,
        workspace: Workspace,
        position: Position,
        plants: Mapping[str, Plant],
        steps: PlantSteps,
        stops: Sequence[int],
        *,
        every: bool,
        plain: bool,
    ):
        self._workspace, self._position, self._stops = workspace, position, stops
        self._plants, self._steps = plants, steps
        self._every, self._possible = every, plain
        self._later: LaterTicks | None = None
        self._spent = 0.0

    def watch(
        self, last: int, progress: Callable[[float], Any], note_due: Callable[[], None]
    ) -> Callable[[float], Any]:
        """Return a ``progress`` for interpreted ticks from here up to a tick, which has the code made in time.

        It calls ``note_due`` once the code is there: nothing is looked at in every tick.
        """
        position, started, before = self._position, perf_counter(), self._spent
        first = position.tick

        def tell(t: float) -> None:
            spent, done = perf_counter() - started, position.tick - first
            self._spent = before + spent
            if self._possible and self._spent > _PATIENCE and done:
                self._look(spent * (last - position.tick) / done)
                if self._later is not None and self._later.code.ready:
                    note_due()
            progress(t)

        return tell

    def _look(self, rest: float) -> None:
        if self._later is None:
            from .compiled_ticks import make_later

            regular = self._steps.regular
            self._later = make_later(self._workspace, self._plants, self._stops, every=self._every, regular=regular)
        if self._later is None:
            self._possible = False
        else:
            self._later.code.look(self._spent, rest)

    def tell_failure(self) -> tuple[str, ...]:
        """Return a message that there is no compiler, or one that fails; once in a process."""
        return () if self._later is None else self._later.tell_failure()

    def take_over(self) -> CompiledTicks | None:
        """Return the ticks in C; None while there is no code."""
        return None if self._later is None else self._later.take_over()
