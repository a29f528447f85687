"""Events of blocks in model exchange that pile up: those of time, of steps, of inputs."""

from __future__ import annotations

import math
from collections import deque

from ...blocks.core import SimulationError
from ..flat import FlatDiagram
from .blocks_in_a_run import BlocksInModelExchange

_ROUNDS = 100  # of events at one instant
_PILED, _PILE_SPAN = (
    500,
    1e-8,
)  # so many instants within so many seconds (relative to 1 + |t|), as for those of indicators
_PILE_PART = 1e-2  # and within so much of the time between two ticks: a run in picoseconds continues
_SLOW_PART = 0.5  # part of the time between two ticks within which so many instants make a run slow


class OwnEvents:
    """Counts of the events of blocks in model exchange, and the errors where they pile up."""

    def __init__(self, blocks: BlocksInModelExchange):
        self.flat: FlatDiagram = blocks.flat
        self._evaluators = blocks.evaluators
        self._recent = {path: deque[float](maxlen=_PILED) for path in self._evaluators}
        """The last instants at which a block had an event of time or of a step."""
        self._reported = set[str]()

    def count(self, t: float, path: str, name: str) -> None:
        """Note an instant of a block's own events; refuse instants that pile up, for the run would not advance."""
        recent = self._recent[path]
        if recent and t <= recent[-1]:
            if t == recent[-1]:
                return
            recent.clear()  # the run has gone back to a saved state
        recent.append(t)
        span, base = t - recent[0], float(self.flat.base)
        if len(recent) < _PILED or span >= min(_PILE_SPAN * (1.0 + abs(t)), _SLOW_PART * base):
            return
        if span >= _PILE_PART * base:
            if path not in self._reported:
                self._reported.add(path)
                self._evaluators[path].block.add_note(
                    f"t = {t:.9g} s: its events ({name}) come every {span / (_PILED - 1):.2g} s, about "
                    f"{base / span * (_PILED - 1):.2g} times between two ticks of {base:g} s, so the run continues "
                    "slowly. Look up in its documentation which input or parameter sets the time between its events"
                )
            return
        time = self._evaluators[path].block.next_time
        counted = (
            f"the next time event is at t + {time - t:.2g} s" if math.isfinite(time) else "it has no time event ahead"
        )
        raise SimulationError(
            f"its events pile up ({name}): they came at {_PILED} instants within {span:.2g} s, while two ticks are "
            f"{base:g} s apart, so the run would not advance; {counted}. Look up in its documentation which "
            "input or parameter sets the time between its events, or report it to its makers.",
            block=path,
            t=t,
        )

    def endless(self, t: float, place: int, name: str) -> SimulationError:
        """Return the error of events that follow each other at one instant without end, of the block at this place."""
        path, e = [*self._evaluators.items()][place]
        return SimulationError(
            f"its events follow each other without end at one instant: after {_ROUNDS} rounds there is still one "
            f"({name}), and its next time event is at {e.block.next_time:.9g} s. Break the "
            "loop of discrete signals around it with a delay, or report it to its makers.",
            block=path,
            t=t,
        )
