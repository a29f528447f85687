"""Blocks in model exchange, handed over to a loop in C and taken back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ...blocks.core import EvaluationVectors, FmuRuntimeError, SimulationError
from ...fmus.calls import WARNING, ModelExchangeInstance
from ..flat import JUMP, FlatDiagram, OpaqueStage
from ..model_exchange import OWN_EVENTS, ModelExchangeEvaluator
from .model_exchange_in_c import NativeModelExchange, OwnEvent

_DONE, _NOT_COMPUTED = range(2)
_FIRED = -1


class ModelExchangeHandOver:
    """Blocks in model exchange, in a run that continues in C.

    Evaluators do what C can't. ``report`` is called with events of the blocks' own; ``count(t, path, name)`` notes one,
    and refuses those that pile up.
    """

    def __init__(
        self,
        flat: FlatDiagram,
        blocks: Mapping[str, Any],
        evaluators: Mapping[str, ModelExchangeEvaluator],
        report: Callable[[OwnEvent], None],
        count: Callable[[float, str, str], None],
    ):
        self._evaluators, self._report, self._count = evaluators, report, count
        self._blocks: dict[str, ModelExchangeInstance] = {path: blocks[path] for path in flat.in_model_exchange}
        first = {path: flat.states.slices[path].start for path in flat.in_model_exchange}
        self.native = NativeModelExchange(self._blocks, first, flat.width, self._by_python)
        """The blocks as C knows them."""
        self._with_c = False

    # --- Python for C ------------------------------------------------------------------------------------------------

    def _by_python(self, stage: OpaqueStage, vectors: EvaluationVectors) -> Callable[[], int]:
        """Return the function that evaluates a stage, or looks at an instant, by Python while C waits."""
        path, evaluator, (t, x, u, into) = stage.path, self._evaluators[stage.path], vectors

        def call() -> None:
            into[:] = evaluator.evaluate(stage.names, float(t[0]), x, u)

        def evaluate() -> int:
            try:
                with self.native.lent(path):
                    call()
            except FmuRuntimeError:
                raise
            except SimulationError:  # a step that is shorter may have values
                return _NOT_COMPUTED
            return _DONE

        def look() -> int:
            with self.native.lent(path):
                self._look(path, float(t[0]), call)
            return _DONE

        return look if stage.names == (JUMP,) else evaluate

    def _look(self, path: str, t: float, call: Callable[[], None]) -> None:
        evaluator, block, state = self._evaluators[path], self._blocks[path], self.native.state_of(path)
        changed = self._take_block(path)
        nominals = np.array(block.nominals)
        event = evaluator.look_at(call, completes_step=self.native.completes_step)
        self._give_block(path)
        state.other_nominals = changed or not np.array_equal(nominals, block.nominals)
        if event is None:
            return
        state.acted, state.event = True, OWN_EVENTS.index(event) if event else _FIRED
        if state.event > 0:
            self._count(t, path, event)

    # --- from one to the other ---------------------------------------------------------------------------------------

    def hand_over(self) -> None:
        """Let C continue from an instant that Python has come to."""
        self._with_c = True
        for path in self._blocks:
            self._give_block(path)

    def _give_block(self, path: str) -> None:
        block, state = self._blocks[path], self.native.state_of(path)
        self.native.hand_over(
            path,
            self.native.inputs_of(path) if state.by_python else block.u,
            block.next_time,
            asks=self._evaluators[path].wants_event,
            ended=block.ends_run,
            final=not state.by_python and block.is_final,
        )

    def take_back(self) -> bool:
        """Let Python continue from where C has come to; return whether nominal values have changed."""
        if not self._with_c:  # Python has continued, and has been interrupted
            return False
        self._with_c = False
        changed = [self._take_block(path) for path in self._blocks]
        return any(changed)

    def _take_block(self, path: str) -> bool:
        block, state = self._blocks[path], self.native.state_of(path)
        changed, state.other_nominals = bool(state.other_nominals), 0
        if state.by_python:
            return changed
        self._evaluators[path].wants_event = bool(state.asks)
        if state.ended and not block.ends_run:
            block.note_end(state.end, in_event=bool(state.in_event))
        block.take_back(self.native.inputs_of(path), state.next_time, read_nominals=changed)
        return changed

    def report(self) -> None:
        """Report what has happened in C: warnings, and events of the blocks' own."""
        self.native.remote.take_messages()
        for path, action, t in self.native.take_warnings():
            self._blocks[path].judge(action, WARNING, t)
        for event in self.native.take_events():
            self._report(event)

    def has_news(self) -> bool:
        """Whether a block asks for the end of the run, or has other nominal values."""
        states = [(self.native.state_of(path), block) for path, block in self._blocks.items()]
        return any(state.other_nominals or (state.ended and not block.ends_run) for state, block in states)

    def judge(self) -> None:
        """Raise the error of the call that has failed."""
        failed = self.native.failure()
        self._blocks[failed.path].judge_native(failed.action, failed.status, failed.t)
