"""`check_block`: checks that a block keeps the contract of blocks."""

from __future__ import annotations

import pickle
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from ...blocks.core import (
    Block,
    DefinitionError,
    LoopwrightError,
    OptionError,
    SampleTimeError,
    Shape,
    ShapeError,
    SimulationError,
    accepts,
    brief,
    explain_calls,
    kinds,
    near,
)
from ...blocks.tracing import trace
from ..results import Run
from .event_rules import check_events, check_smooth, find_instants
from .exercise import Bench, Exercise, kind_text, points
from .traces import check_derivatives, check_feedthrough, check_guards, check_shapes, check_trace, find_swallowed
from .value_rules import check_after_start, check_ports, check_purity, check_values, describe_units, rule_error

Pairs = frozenset[tuple[str, str]]
"""Pairs (input, output)."""


@explain_calls
@dataclass(frozen=True)
class BlockReport:
    """Findings of `check_block` about a block that keeps its contract.

    Attributes
    ----------
    block : str
        Name of the block.
    kinds : mapping
        For "sampled" and "continuous": "checked", or the reason why the block refuses to be in such a subsystem.
    checks : mapping
        Result of each check, with numbers, by "sampled: rule", "continuous: rule" or by rule.
    feedthrough : mapping
        For "sampled" and "continuous": the pairs (input, output) in which the output changed with the input.
    unseen : mapping
        Likewise, the pairs of the trace in which it never did. Blocks are ordered as if it did.
    swallowed : mapping
        Likewise, the pairs in which the output changes with numbers, but never becomes NaN with the input, as with
        ``np.where(u > 0.0, 1.0, 0.0)``.
    quiet : tuple of str
        Events that never fired, in the exercise and in the run.
    """

    block: str
    kinds: Mapping[str, str]
    checks: Mapping[str, str]
    feedthrough: Mapping[str, Pairs] = field(default_factory=dict)
    unseen: Mapping[str, Pairs] = field(default_factory=dict)
    swallowed: Mapping[str, Pairs] = field(default_factory=dict)
    quiet: tuple[str, ...] = ()

    def __repr__(self) -> str:
        facts = f"{self.block} keeps the contract of a block", f"{len(self.checks)} checks"
        return brief("check of a block", *facts, then="print(…) shows all")

    def __str__(self) -> str:
        lines = [f"{self.block} keeps the contract of a block."]
        lines += [f"  {kind} subsystem: {text}" for kind, text in self.kinds.items()]
        lines += [f"  {rule}: {text}" for rule, text in self.checks.items()]
        for kind, pairs in self.unseen.items():
            lines += [f"  {kind}: {y} depends on {u} in the trace, and never did" for u, y in sorted(pairs)]
        for kind, pairs in self.swallowed.items():
            lines += [f"  {kind}: {y} is a number where {u} is NaN" for u, y in sorted(pairs)]
        lines += [f"  event {name}: never fired" for name in self.quiet]
        return "\n".join(lines)


@accepts(
    inputs=kinds.mapping,
    shapes=kinds.mapping,
    ticks=kinds.count,
    seed=kinds.count,
    kinds=kinds.names,
    duration=kinds.number,
)
def check_block(
    block: Block,
    inputs: Mapping[str, object] | None = None,
    *,
    shapes: Mapping[str, Shape] | None = None,
    sample_time: float = 0.01,
    ticks: int = 100,
    seed: int = 0,
    kinds: Iterable[str] = (),
    duration: float | None = None,
) -> BlockReport:
    """Check that a block keeps the contract of blocks, the library's or one of your own.

    - Values: pickling and ``replace`` give an equal block, a changed parameter another one.
    - Ports: units can be read, and there are as many as entries; ``like`` names an input. Where some variables have
      units, the report names those without, which `build` refuses.
    - Purity: the same arguments give the same results and stay unchanged; equations leave the block unchanged.
    - Shapes and traced results are NumPy's at random points; derivatives of the trace are those of differences.
    - Feedthrough: no output changes with an input that the trace doesn't show.
    - Smoothness in a continuous subsystem: outputs and rates jump only at `next_instant` and where an event's indicator
      changes its sign. Indicators are finite, and jumps at one instant come to an end.
    - ``after_start`` gives finite states, from its own states the same again, and with them the outputs of the start.
    - Runs in a sampled and in a continuous subsystem, where the block allows it: a run that continues from a saved
      state, pickled, equals the straight run bit for bit.

    An FMU and a transport delay have no equations; their values, ports and runs are checked.

    Parameters
    ----------
    block : Block
        The block.
    inputs : mapping, optional
        For each input by name: a range ``(low, high)``, or a signal (its own source). Without one, the range from
        the port's minimum to its maximum, else three times its nominal value to both sides.
    shapes : mapping, optional
        Shapes of inputs that take any; scalars without it.
    sample_time : float
        Sample time of the sampled subsystem, and time between samples in the continuous one, in s.
    ticks : int
        Length of the runs in sample times, at least 4.
    seed : int
        Seed of points and signals.
    kinds : list of str, optional
        "sampled", "continuous" or both: kinds of subsystems in which the block must be. Without it, those that it
        doesn't refuse.
    duration : float, optional
        Time in s over which jumps in time are looked for: give that of your runs. The length of the runs here without
        it. An input that is wired to a `Clock` goes with the time.

    Returns
    -------
    BlockReport
        The findings; ``print`` them.

    Raises
    ------
    DefinitionError
        A rule that is not kept: the finding, the expectation, and the next step. A `TraceError`, `ShapeError` or
        `UnitError` where it is of this kind.
    SimulationError
        A run of the block that stopped; other ranges of its inputs may be needed.

    Examples
    --------
    >>> from loopwright import check_block
    >>> from loopwright.blocks import Saturation
    >>> report = check_block(Saturation(limit=1.0), shapes={"u": (2,)})
    >>> report.kinds
    {'sampled': 'checked', 'continuous': 'checked'}
    """
    if not isinstance(block, Block):
        raise DefinitionError(
            f"found {block!r}; expected a block, such as Gain(gain=2). Give an object, not its class."
        )
    checks = {"values": check_values(block)}
    exercise = Exercise.of(block, inputs or {}, shapes or {}, sample_time, ticks, seed)
    checks["ports"] = check_ports(block)
    if lacking := describe_units(block):
        checks["units"] = lacking
    span = exercise.duration if duration is None else float(duration)
    announced = find_instants(block, span)
    checks["next_instant"] = f"{len(announced)} within {span:g} s"
    wanted = _choose_kinds(kinds)
    parts = [_check_in(exercise, sampled, announced, span) for sampled in wanted]
    refused = [error for _, error in parts if error is not None]
    if refused and (kinds or len(refused) == len(wanted)):
        raise refused[0]
    return _gather(block.label, checks, [part for part, _ in parts])


def _choose_kinds(kinds: Iterable[str]) -> list[bool]:
    """Return the wanted kinds of subsystems: sampled True, continuous False."""
    names = [kind_text(sampled) for sampled in (True, False)]
    for name in (given := list(kinds)):
        if name not in names:
            raise OptionError(
                f"found {name!r}; expected 'sampled' or 'continuous'. {near(name, names)}",
                block="check_block",
                port="kinds",
            )
    return [sampled for sampled in (True, False) if not given or kind_text(sampled) in given]


def _check_in(
    exercise: Exercise, sampled: bool, announced: list[float], duration: float
) -> tuple[BlockReport, LoopwrightError | None]:
    """Check the block in a subsystem of one kind; return the findings, and the error by which it refuses that kind."""
    block, kind, checks = exercise.block, kind_text(sampled), dict[str, str]()
    if block.transport or block.stepped:  # it has no equations
        checks["run"], _ = check_run(exercise, sampled)
        return _report(block, kind, checks), None
    places = list(points(exercise, np.random.default_rng([exercise.seed, 20140]), 6))
    equations = check_purity(exercise, sampled, places)
    try:
        traced = trace(block, exercise.shapes, sampled=sampled, cache={})
    except (SampleTimeError, ShapeError) as error:
        vector = any(exercise.shapes.values())
        if isinstance(error, ShapeError) and (sampled or not block.events or not vector):
            raise
        return BlockReport(block.label, {kind: str(error)}, {}), error
    bench = Bench(exercise, sampled, traced)
    checks["purity"] = f"{equations} equations"
    if hasattr(block, "after_start"):
        checks["after_start"] = check_after_start(exercise, sampled, places, traced.states)
    check_shapes(bench)
    checks["trace"] = f"as NumPy to {check_trace(bench):.1e}, at {len(bench.points)} points"
    checks["derivatives"] = f"as differences to {check_derivatives(bench):.1e}"
    measured, unseen = check_feedthrough(bench)
    pairs = {
        "feedthrough": frozenset(measured),
        "unseen": frozenset(unseen),
        "swallowed": frozenset(find_swallowed(bench, measured)),
    }
    checks["feedthrough"] = f"{len(measured)} pairs, {len(unseen)} more in the trace"
    if guards := check_guards(bench):
        checks["guards"] = str(guards)
    quiet = set[str]()
    if not sampled:
        checks["smooth"] = f"{check_smooth(bench, announced, duration)} intervals"
        count, quiet = check_events(bench)
        if block.events:
            checks["events"] = f"{count} fired in small steps"
    checks["run"], fired = check_run(exercise, sampled)
    return _report(block, kind, checks, pairs, quiet - fired), None


def _report(
    block: Block,
    kind: str,
    checks: Mapping[str, str],
    pairs: Mapping[str, Pairs] = MappingProxyType({}),
    quiet: Iterable[str] = (),
) -> BlockReport:
    """Return the findings in a subsystem of one kind: results by rule, and the sets of pairs of a `BlockReport`."""
    results = {f"{kind}: {rule}": text for rule, text in checks.items()}
    found: dict[str, Any] = {name: {kind: some} for name, some in pairs.items()}
    return replace(BlockReport(block.label, {kind: "checked"}, results, quiet=tuple(sorted(quiet))), **found)


def _gather(label: str, checks: Mapping[str, str], parts: Sequence[BlockReport]) -> BlockReport:
    """Return one report of the findings that hold for all kinds of subsystems, and of those for each kind."""
    return BlockReport(
        label,
        kinds={kind: text for part in parts for kind, text in part.kinds.items()},
        checks={**checks, **{rule: text for part in parts for rule, text in part.checks.items()}},
        feedthrough={kind: pairs for part in parts for kind, pairs in part.feedthrough.items()},
        unseen={kind: pairs for part in parts for kind, pairs in part.unseen.items()},
        swallowed={kind: pairs for part in parts for kind, pairs in part.swallowed.items()},
        quiet=tuple(name for part in parts for name in part.quiet),
    )


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
