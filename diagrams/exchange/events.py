"""Events of blocks that are evaluated from outside: those of indicators, of time, of steps, of inputs."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from ...blocks.core import SimulationError
from ..flat import FlatDiagram
from .evaluator import INPUT_EVENT, STEP_EVENT, TIME_EVENT, Look
from .exchanged_blocks import ExchangedBlocks

_ROUNDS = 100  # of events at one instant
_MANY, _SPAN = 500, 1e-8  # so many instants within so many seconds (relative to 1 + |t|), as for those of indicators
_PART = 1e-2  # and within so much of the time between two ticks: a run in picoseconds goes on
_SLOW = 0.5  # part of the time between two ticks within which so many instants make a run slow


class OutsideEvents:
    """Events of blocks from outside, in the run that they belong to.

    Parameters
    ----------
    blocks : ExchangedBlocks
        The blocks.
    x : ndarray
        The states of the instant that the run has reached.
    jump : callable
        Evaluates `JUMP` of all blocks, and takes over the states after it.
    tell : callable
        ``tell(t, path, name, before)``: told every event that acts, with all states before it.
    follow : callable
        Called after events, which may have changed states and nominal values.
    """

    def __init__(
        self,
        blocks: ExchangedBlocks,
        x: np.ndarray,
        jump: Callable[[np.ndarray], None],
        tell: Callable[[float, str, str, np.ndarray], None],
        follow: Callable[[], None],
    ):
        self.flat: FlatDiagram = blocks.flat
        self._evaluators, self._x, self._jump = blocks.evaluators, x, jump
        self._tell, self._follow = tell, follow
        self._nothing = np.zeros(len(self.flat.events))
        self._recent = {path: deque[float](maxlen=_MANY) for path in self._evaluators}
        """The last instants at which a block had an event of time or of a step."""
        self._told = set[str]()

    def next_instant(self, t: float) -> float:
        """Return the first time event of any block after t, in s; infinite without one."""
        return min(e.next_instant(t) for e in self._evaluators.values())

    def complete_step(self) -> bool:
        """Tell the blocks that the solver has accepted a step; return whether one wants an event, or the end, there."""
        for e in self._evaluators.values():
            e.look = Look.STEP
        try:
            self._jump(self._nothing)
        finally:
            for e in self._evaluators.values():
                e.look = Look.EVENTS
        return any(e.wants_event or e.block.ends_run for e in self._evaluators.values())

    def fire(self, t: float, fired: np.ndarray) -> bool:
        """Let events act, those of indicators that fire and the blocks' own; return whether any block had one."""
        before = self._x.copy()
        for e in self._evaluators.values():
            e.event = None
        self._jump(fired)
        found = False
        for path, e in self._evaluators.items():
            if e.event is None:
                continue
            found, where = True, self.flat.states.slices[path]
            if e.event and (e.event != INPUT_EVENT or not np.array_equal(before[where], self._x[where])):
                self._tell(t, path, e.event, before)
            if e.event in (TIME_EVENT, STEP_EVENT):
                self._count(t, path, e.event)
        if found:
            self._follow()
        return found

    def _count(self, t: float, path: str, name: str) -> None:
        """Note an instant of a block's own events; refuse instants that pile up, for the run would not go on."""
        recent = self._recent[path]
        if recent and t <= recent[-1]:
            if t == recent[-1]:
                return
            recent.clear()  # the run has gone back to a saved state
        recent.append(t)
        span, base = t - recent[0], float(self.flat.base)
        if len(recent) < _MANY or span >= min(_SPAN * (1.0 + abs(t)), _SLOW * base):
            return
        if span >= _PART * base:
            if path not in self._told:
                self._told.add(path)
                self._evaluators[path].block.add_note(
                    f"t = {t:.9g} s: its events ({name}) come every {span / (_MANY - 1):.2g} s, about "
                    f"{base / span * (_MANY - 1):.2g} times between two ticks of {base:g} s, so the run goes on "
                    "slowly. Look up in its documentation which input or parameter sets the time between its events"
                )
            return
        time = self._evaluators[path].block.next_time
        told = f"the next time event is at t + {time - t:.2g} s" if np.isfinite(time) else "it has no time event ahead"
        raise SimulationError(
            f"its events pile up ({name}): they came at {_MANY} instants within {span:.2g} s, while two ticks are "
            f"{base:g} s apart, so the run would not go on; {told}. Look up in its documentation which "
            "input or parameter sets the time between its events, or report it to its makers.",
            block=path,
            t=t,
        )

    def settle(self, t: float) -> bool:
        """Let events of the blocks' own act until there are none; return whether there were any.

        Raises
        ------
        SimulationError
            If they go on without end.
        """
        for rounds in range(_ROUNDS):
            if not self.fire(t, self._nothing):
                return rounds > 0
        path, e = next((path, e) for path, e in self._evaluators.items() if e.event is not None)
        raise SimulationError(
            f"its events follow each other without end at one instant: after {_ROUNDS} rounds there is still one "
            f"({e.event or 'of an indicator'}), and its next time event is at {e.block.next_time:.9g} s. Break the "
            "loop of discrete signals around it with a delay, or report it to its makers.",
            block=path,
            t=t,
        )
