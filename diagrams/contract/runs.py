"""The rule that a run of a block keeps: saved and restored, it goes on as before; see `check_block`."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np

from ...blocks.core.block import Block
from ...blocks.core.errors import SimulationError
from ..simulation.simulation import Simulation
from .exercise import Exercise, kind_text
from .values import rule_error


def check_run(exercise: Exercise, sampled: bool) -> tuple[str, set[str]]:
    """Run the block, save and restore in the middle; return what was done, and the events that fired."""
    block, kind = exercise.block, kind_text(sampled)
    diagram = exercise.diagram(sampled)
    half = exercise.sample_time * (exercise.ticks // 2)
    half = float(f"{half:.12g}")
    options: dict[str, Any] = {"step": exercise.sample_time}
    try:
        with diagram.simulation(**options) as straight:
            straight.advance(half)
            before = straight.run()
            if before.final_state is None:
                return "without saving: it can't save its state", {e.event for e in before.events}
            saved = pickle.dumps(before.final_state)
            straight.advance(half)
            expected = straight.run()
            straight.restore(before.final_state)
            straight.advance(half)
            _compare(block, kind, expected, _later(straight, before))
        with diagram.simulation(**options) as other:
            other.advance(exercise.sample_time)
            other.restore(pickle.loads(saved))
            other.advance(half)
            _compare(block, kind, expected, _later(other, before))
    except SimulationError as error:
        error.add_note(
            f"This is check_block's run of {block.label} in a {kind} frame. If its inputs were out of range there, "
            "give check_block(…, inputs={…}) others."
        )
        raise
    events = [*before.events, *expected.events]
    end = f", stopped at {expected.stopped.t:.6g} s" if expected.stopped else ""
    text = f"{len(before.t) + len(expected.t)} samples, {len(events)} events{end}; restored, it is the same"
    return text, {e.event for e in events}


def _later(simulation: Simulation, before: Any) -> Any:
    return simulation.run(), before.final_state.t


def _compare(block: Block, kind: str, expected: Any, found: tuple[Any, float]) -> None:
    """Compare a restored run with the straight one, after the instant at which it was saved."""
    run, t = found
    rows = [np.column_stack([r.t, r.data])[r.t > t] for r in (expected, run)]
    events = [[(e.t, e.event) for e in r.events if e.t > t] for r in (expected, run)]
    same_shape = rows[0].shape == rows[1].shape
    same = same_shape and np.array_equal(rows[0], rows[1], equal_nan=True)
    if same and events[0] == events[1]:
        return
    where = "in its events"
    if same_shape and not same:
        first = np.argwhere(~((rows[0] == rows[1]) | (np.isnan(rows[0]) & np.isnan(rows[1]))))[0][0]
        where = (
            f"from t = {rows[0][first, 0]:.9g} s on, {rows[1][first, 1:].tolist()} for {rows[0][first, 1:].tolist()}"
        )
    raise rule_error(
        "runs",
        f"in a {kind} frame a run that was saved at t = {t:g} s and restored is another one {where}; expected the "
        "straight run, bit for bit. What a block remembers must be in its states.",
        block,
    )
