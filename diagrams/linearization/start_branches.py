"""Branches of the start: blocks that act at their first instant in another way than later (`Block.after_start`).

An operating point at the start has the states of such blocks after that branch; its signals stay those of the start.
The equations themselves are evaluated just after t in all linear models (`evaluate` with ``begun``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from ...blocks.core import LoopwrightError, SimulationError
from ...blocks.tracing import bundle, state_after_start
from ..flat import FlatDiagram, sample_time_of
from ..wiring import join


def leave_start(flat: FlatDiagram, x: np.ndarray, values: Mapping[str, Any]) -> np.ndarray:
    """Return x with the states of all blocks after their branches of the start; x itself where none changes."""
    found = x.copy()
    for path, trace in flat.checked.traced.items():
        block = flat.table.blocks[path]
        if not trace.states or not hasattr(block, "after_start"):
            continue
        where, T = flat.states.slices[path], sample_time_of(flat.table, path)
        states = bundle("x", flat.states.of_block[path].split(x))
        inputs = bundle("u", {name: _signal(flat, path, name, values) for name in trace.inputs})
        try:
            found[where] = state_after_start(block, trace.states, states, inputs, None if math.isnan(T) else T)
        except LoopwrightError as error:
            raise error.at(block=path) from error.__cause__
        except Exception as error:  # a user's function may raise anything
            raise SimulationError(
                f"its after_start(x, u, T) failed: {type(error).__name__}: {error}; expected "
                f"{', '.join(trace.states)}. Mend it.",
                block=path,
            ) from error
    return x if np.array_equal(found, x) else found


def _signal(flat: FlatDiagram, path: str, name: str, values: Mapping[str, Any]) -> np.ndarray:
    """Return the value at an input of a block."""
    wire = flat.table.wires.get((path, name))
    if wire is None:
        return np.asarray(flat.table.blocks[path].inputs[name].default, dtype=float)
    whole = np.asarray(values[join(wire.block, wire.port)], dtype=float)
    part = whole if wire.index is None else whole[wire.index]
    return np.asarray(part).reshape(flat.checked.traced[path].inputs[name])
