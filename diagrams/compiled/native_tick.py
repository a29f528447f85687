"""A compiled tick as a call from Python."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ...blocks.interrupts import INTERRUPTS
from .bound_functions import TICK
from .staged_functions import Staged
from .tick_code import CompiledTick


def bind_call(tick: CompiledTick, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> Callable[[], None]:
    """Return a tick bound to the vectors (t, x, w, p) and (x_next, z, log, ok) of a run as a call from Python."""
    assert not isinstance(tick, Staged)
    bound = tick.bind(arguments, results)
    of = bound.structure
    function = TICK(of.evaluate)

    def call() -> None:
        if function(of.arguments, of.results, of.iw, of.w, 0):
            raise bound.failures.pop()
        if INTERRUPTS.came:
            INTERRUPTS.check()

    return call
