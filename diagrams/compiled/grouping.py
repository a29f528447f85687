"""Grouping: the calls of a tick as runs of equal blocks, with tables of where their values are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from heapq import heapify, heappop, heappush

import numpy as np

from ...blocks.core import without_collection
from ..flat import COPY, Ids, Operation, PartProgram, Program, TickProgram
from .kernels import Kernel

PYTHON = -1
"""In place of a kernel: blocks that Python evaluates."""


@dataclass(frozen=True, eq=False)
class PythonCall:
    """A block that Python evaluates."""

    key: int  # of its function in `Program.functions`
    arguments: tuple[slice, ...]  # where its columns are: the last argument in p, all others in v
    results: tuple[slice, ...]


@dataclass(frozen=True, eq=False)
class BlockCalls:
    """The calls of blocks in a function, as runs of equal blocks."""

    runs: np.ndarray  # int32, shape (n, 3): kernel, number of blocks, and where their rows begin
    rows: np.ndarray  # int32: where the values are, block by block
    python: Sequence[PythonCall]  # blocks that Python evaluates; their rows are their places in it


@dataclass(frozen=True, eq=False)
class TickTables:
    """A tick as tables for kernels; places are entries of v, and int32."""

    calls: BlockCalls
    memory: np.ndarray  # v with its constants
    next: int  # where the next states begin
    inputs: np.ndarray
    guards: np.ndarray
    made: np.ndarray  # both sides of the algebraic loops
    taken: np.ndarray
    log: int  # entries of the log without the residual
    residual: bool  # whether the log ends with the residual of algebraic loops
    unread: np.ndarray  # entries of the log that may be no finite numbers, ascending


@without_collection
def make_tables(tick: TickProgram, kernels: Mapping[int | str, Kernel]) -> TickTables:
    """Return the tables of a tick; functions without a kernel are evaluated by Python."""
    program = tick.program
    places, memory, first = _place(tick)
    p_first = program.p.ids.start if isinstance(program.p.ids, range) else 0
    runs, rows, python = _write_runs(program, program.operations, kernels, places, p_first)
    copies = _copies(tick, places, first)
    if len(copies):
        runs.append((kernels[COPY].place, len(copies), len(rows)))

    def where(ids: Ids) -> np.ndarray:
        return np.ascontiguousarray(places[np.array(ids, dtype=np.int64)], dtype=np.int32)

    around, taken = tick.mismatch or (range(0), range(0))
    every = np.concatenate([np.array(rows, dtype=np.int32), copies.ravel()])
    return TickTables(
        calls=BlockCalls(np.array(runs, dtype=np.int32).reshape(-1, 3), every, python),
        memory=memory,
        next=first,
        inputs=where(tick.z),
        guards=where(tick.guards),
        made=where(around),
        taken=where(taken),
        log=len(tick.log),
        residual=tick.mismatch is not None,
        unread=np.ascontiguousarray(tick.unread, dtype=np.int32),
    )


@dataclass(frozen=True, eq=False)
class PartTables:
    """A function between ticks as tables for kernels."""

    calls: BlockCalls
    memory: np.ndarray  # v with its constants
    where: np.ndarray  # int32: where the results are in v, one after the other
    lengths: tuple[int, ...]  # entries of each result


@without_collection
def make_part_tables(part: PartProgram, kernels: Mapping[int | str, Kernel]) -> PartTables:
    """Return the tables of a function between ticks; see `make_tables`.

    v holds the time, w, x, further arguments, and whatever the operations make.
    """
    program = part.program
    places, end = np.full(program.count, -1, dtype=np.int64), 0
    for cells in (program.t, program.w, program.x, program.more):
        places[cells.ids] = end + np.arange(len(cells.ids))
        end += len(cells.ids)
    places[program.p.ids] = np.arange(len(program.p.ids))
    for column in program.columns:
        places[column.start : column.stop] = end + np.arange(len(column))
        end += len(column)
    memory = np.zeros(end + 1)
    if program.constants:
        memory[places[[*program.constants]]] = [*program.constants.values()]
    p_first = program.p.ids.start if isinstance(program.p.ids, range) else 0
    runs, rows, python = _write_runs(program, part.operations, kernels, places, p_first)
    return PartTables(
        calls=BlockCalls(np.array(runs, dtype=np.int32).reshape(-1, 3), np.array(rows, dtype=np.int32), python),
        memory=memory,
        where=places[[value for ids in part.results for value in ids]].astype(np.int32),
        lengths=tuple(map(len, part.results)),
    )


def _write_runs(
    program: Program,
    operations: Sequence[Operation],
    kernels: Mapping[int | str, Kernel],
    places: np.ndarray,
    p_first: int,
) -> tuple[list[tuple[int, int, int]], list[int], list[PythonCall]]:
    """Return the runs of equal blocks, their rows, and the calls of Python among them."""
    runs, rows, python = list[tuple[int, int, int]](), list[int](), list[PythonCall]()
    at = places.tolist()
    for run in _runs(program, operations, kernels):
        kernel = kernels.get(run[0].kernel)
        start = len(rows)
        if kernel is None:
            for op in run:
                rows.append(len(python))
                python.append(_python_call(op, at, p_first))
            runs.append((PYTHON, len(run), start))
            continue
        for op in run:
            given, made = op.arguments, op.results
            for out, k in kernel.columns:
                rows.append(at[made[k].start] if out else at[given[k].start])
        runs.append((kernel.place, len(run), start))
    return runs, rows, python


def _place(tick: TickProgram) -> tuple[np.ndarray, np.ndarray, int]:
    """Return where each value is in v (those of p: in p), v with its constants, and where the next states are.

    Results that are recorded, or are next states, are made where these are.
    """
    program = tick.program
    places = np.full(program.count, -1, dtype=np.int64)
    log = np.array(tick.log, dtype=np.int64)
    first = 1 + len(log)
    places[program.t.ids] = 0
    places[program.p.ids] = np.arange(len(program.p.ids))
    places[program.w.ids] = 1 + np.arange(len(program.w.ids))
    places[program.x.ids] = first - len(program.x.ids) + np.arange(len(program.x.ids))
    end = first + len(tick.x_next)
    wanted = np.full(program.count, -1, dtype=np.int64)
    x_next = np.array(tick.x_next, dtype=np.int64)
    wanted[x_next[::-1]] = first + np.arange(len(x_next))[::-1]
    wanted[log[::-1]] = 1 + np.arange(len(log))[::-1]
    for column in program.columns:
        size, place = len(column), int(wanted[column.start])
        if (
            place < 0
            or column.start in program.constants
            or (size > 1 and not np.array_equal(wanted[column.start : column.stop], np.arange(place, place + size)))
        ):
            place, end = end, end + size
        places[column.start : column.stop] = np.arange(place, place + size) if size > 1 else place
    memory = np.zeros(end + 1)
    if program.constants:
        memory[places[[*program.constants]]] = [*program.constants.values()]
    return places, memory, first


def _copies(tick: TickProgram, places: np.ndarray, first: int) -> np.ndarray:
    """Return from where to where values are copied that are made in another place than where they are wanted."""
    log, x_next = np.array(tick.log, dtype=np.int64), np.array(tick.x_next, dtype=np.int64)
    source = np.concatenate([places[log], places[x_next]])
    target = np.concatenate([1 + np.arange(len(log)), first + np.arange(len(x_next))])
    apart = source != target
    return np.stack([source[apart], target[apart]], axis=1).astype(np.int32)


def _python_call(op: Operation, at: Sequence[int], p_first: int) -> PythonCall:
    *given, parameters = op.arguments

    def place(column: range) -> slice:
        return slice(at[column.start], at[column.start] + len(column)) if len(column) else slice(0, 0)

    p = slice(parameters.start - p_first, parameters.stop - p_first)
    return PythonCall(int(op.kernel), (*map(place, given), p), tuple(map(place, op.results)))


def _runs(
    program: Program, operations: Sequence[Operation], kernels: Mapping[int | str, Kernel]
) -> list[list[Operation]]:
    """Return the operations as runs of one kernel each, every operation after those whose results it takes.

    Of the kernels that something is ready for, the one with most operations comes first.
    """
    given = program.given
    maker = [-1] * program.count
    for i, op in enumerate(operations):
        for column in op.results:
            for value in column:
                maker[value] = i
    kinds = [PYTHON if (k := kernels.get(op.kernel)) is None else k.place for op in operations]
    waits, users = [0] * len(operations), [list[int]() for _ in operations]
    for i, op in enumerate(operations):
        found = {maker[v] for column in op.arguments if column.start >= given for v in column} - {-1}
        waits[i] = len(found)
        for j in found:
            users[j].append(i)
    ready: dict[int, list[int]] = {}
    for i, count in enumerate(waits):
        if not count:
            ready.setdefault(kinds[i], []).append(i)
    heap = [(-len(queue), kind) for kind, queue in ready.items()]
    heapify(heap)
    runs = []
    while heap:
        size, kind = heappop(heap)
        queue = ready.get(kind, [])
        if not queue or -size != len(queue):  # the queue has grown, or was taken
            continue
        ready[kind] = []
        queue.sort()
        runs.append([operations[i] for i in queue])
        changed = set()
        for i in queue:
            for user in users[i]:
                waits[user] -= 1
                if not waits[user]:
                    ready.setdefault(kinds[user], []).append(user)
                    changed.add(kinds[user])
        for other in sorted(changed):
            heappush(heap, (-len(ready[other]), other))
    return runs
