"""Rule of a block's runs: saved and restored, a run continues as before; see `check_block`."""

from __future__ import annotations

import pickle

import numpy as np

from ...blocks.core import Block, SimulationError
from ..results import Run
from .exercise import Exercise, kind_text
from .value_rules import rule_error


def check_run(exercise: Exercise, sampled: bool) -> tuple[str, set[str]]:
    """Run the block, save and restore in the middle; return a summary, and the events that fired."""
    block, kind = exercise.block, kind_text(sampled)
    diagram = exercise.diagram(sampled)
    half = exercise.sample_time * (exercise.ticks // 2)
    half = float(f"{half:.12g}")
    try:
        with diagram.simulation(step=exercise.sample_time) as straight:
            straight.advance(half)
            before = straight.run()
            if before.final_state is None:
                return "without saving: it can't save its state", {e.event for e in before.events}
            saved = pickle.dumps(before.final_state)
            straight.advance(half)
            expected = straight.run()
            straight.restore(before.final_state)
            straight.advance(half)
            _compare(block, kind, expected, straight.run(), before.final_state.t)
        with diagram.simulation(step=exercise.sample_time) as other:
            other.advance(exercise.sample_time)
            other.restore(pickle.loads(saved))
            other.advance(half)
            _compare(block, kind, expected, other.run(), before.final_state.t)
    except SimulationError as error:
        error.add_note(
            f"check_block ran {block.label} in a {kind} subsystem. If its inputs were out of range there, give others: "
            "check_block(…, inputs={…})."
        )
        raise
    events = [*before.events, *expected.events]
    end = f", stopped at {expected.stopped.t:.6g} s" if expected.stopped else ""
    text = f"{len(before.t) + len(expected.t)} samples, {len(events)} events{end}; restored, it is the same"
    return text, {e.event for e in events}


def _compare(block: Block, kind: str, expected: Run, found: Run, t: float) -> None:
    """Compare a restored run with the straight one, after the instant ``t`` at which it was saved."""
    rows = [np.column_stack([r.t, r.data])[r.t > t] for r in (expected, found)]
    events = [[(e.t, e.event) for e in r.events if e.t > t] for r in (expected, found)]
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
        f"in a {kind} subsystem a run that was saved at t = {t:g} s and restored is another one {where}; expected the "
        "straight run, bit for bit. Keep all that the block remembers in its states.",
        block,
    )
