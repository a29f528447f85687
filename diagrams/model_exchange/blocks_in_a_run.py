"""All blocks of a run in model exchange: loading, and the start."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np

from ...blocks.core import FmuRuntimeError, LoopwrightError, SimulationError
from ..flat import FlatDiagram
from .evaluator import Look, ModelExchangeBlock, ModelExchangeEvaluator

_SETTLED = 1e-13  # relative change of a state between two passes at the start, a few hundred ulps


class BlocksInModelExchange:
    """All blocks of a run in model exchange, with their events."""

    def __init__(self, flat: FlatDiagram):
        self.flat = flat
        self.evaluators = {path: ModelExchangeEvaluator(flat, path) for path in flat.in_model_exchange}
        """Their evaluators, by path; they are there before the blocks are loaded."""
        self.blocks: dict[str, ModelExchangeBlock] = {}
        """The blocks that are loaded, by path."""

    def __bool__(self) -> bool:
        return bool(self.evaluators)

    def load(self, stack: ExitStack, start_time: float) -> None:
        """Load the blocks for a run from a time in s on; ``stack`` unloads them."""
        for path, evaluator in self.evaluators.items():
            block: Any = self.flat.table.blocks[path]  # an `Fmu`, or one of a user's; see `loopwright.Block`
            try:
                wired = [port for port in block.inputs if (path, port) in self.flat.table.wires]
                self.blocks[path] = stack.enter_context(block.exchange(wired, start_time=start_time))
                evaluator.load(self.blocks[path])
            except SimulationError as error:
                error.at(block=path, t=start_time)
                raise
            except LoopwrightError as error:
                error.at(block=path)
                raise

    # --- the start ---------------------------------------------------------------------------------------------------

    def exchange(self, x: np.ndarray, look: Callable[[], None]) -> str:
        """Set the inputs of all blocks, and write the states that follow into x; return the path of one that moved."""
        moved, before = "", {path: e.u for path, e in self.evaluators.items()}
        look()  # evaluates `JUMP`, which brings the inputs
        for path, e in self.evaluators.items():
            where = self.flat.states.slices[path]
            states = e.block.exchange(e.u)
            if not (_is_close(before[path], e.u) and _is_close(x[where], states)):
                moved = path
            x[where] = states
        return moved

    def begin(self, x: np.ndarray) -> None:
        """End the start: events there act, and the states after them are in x."""
        for path, e in self.evaluators.items():
            x[self.flat.states.slices[path]] = e.block.begin_exchange()
            e.look = Look.EVENTS

    def ends_run(self) -> str:
        """Return the path of a block that asks for the end of the run; empty if none does."""
        return next((path for path, block in self.blocks.items() if block.ends_run), "")

    def explain(self, error: SimulationError) -> None:
        """Add to the error of a solver what its block could not compute since the last step."""
        block = self.blocks.get(error.block or "")
        if block is not None and block.discarded and not isinstance(error, FmuRuntimeError):
            error.add(f" The FMU discards what the solver tries: {block.discarded}.")

    def nominals(self) -> np.ndarray:
        """Return the nominal value of each entry of x, 1 for those of other blocks."""
        found = np.ones(self.flat.width)
        for path, e in self.evaluators.items():
            found[self.flat.states.slices[path]] = e.block.nominals
        return found


def _is_close(before: np.ndarray, now: np.ndarray) -> bool:
    return before.shape == now.shape and np.allclose(before, now, rtol=_SETTLED, atol=0.0, equal_nan=True)
