"""The order of evaluation, from feedthrough between ports.

A block's outputs, its next state and its guards are ordered one by one: each waits only for the inputs that it
depends on. So a cycle in the drawing is no algebraic loop as long as no port waits for itself. Blocks are taken by
path, so the order never depends on how a diagram was written down.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Mapping

from ..blocks._comparison import GUARDS, NEXT
from ..blocks._errors import AlgebraicLoopError
from ..blocks._tracing import Traced
from ._structure import Structure

Port = tuple[str, str]
Step = tuple[str, tuple[str, ...]]
"""A block's path, and what is evaluated of it together."""


def dependencies(table: Structure, traced: Mapping[str, Traced], *, start: bool = False) -> dict[Port, set[Port]]:
    """Return, for every output, next state and guard, the output ports that it waits for.

    With ``start`` it is the graph of initialization, in which a block that computes its initial state from its inputs
    waits for all of them first.
    """
    waits: dict[Port, set[Port]] = {}
    for path, trace in traced.items():
        all_inputs = start and table.blocks[path].starts_from_inputs
        for name in (*trace.outputs, NEXT, GUARDS):
            inputs = trace.inputs if all_inputs else trace.depends[name]
            wires = (table.wires.get((path, port)) for port in trace.inputs if port in inputs)
            waits[path, name] = {(w.block, w.port) for w in wires if w is not None and w.block in traced}
    return waits


def evaluation_order(table: Structure, traced: Mapping[str, Traced], *, start: bool = False) -> list[Step]:
    """Return what to evaluate, in order; a block is evaluated in one go where its inputs allow it.

    Raises
    ------
    AlgebraicLoopError
        With the loop printed port by port.
    """
    waits = dependencies(table, traced, start=start)
    missing = {port: len(sources) for port, sources in waits.items()}
    consumers: dict[Port, list[Port]] = defaultdict(list)
    for port in sorted(waits):
        for source in waits[port]:
            consumers[source].append(port)
    names = {path: (*trace.outputs, NEXT, GUARDS) for path, trace in traced.items()}
    left = {path: set(every) for path, every in names.items()}
    ready: dict[str, set[str]] = {path: {n for n in every if not missing[path, n]} for path, every in names.items()}
    whole = [path for path in names if ready[path] == left[path]]
    part = [path for path in names if ready[path]]
    heapq.heapify(whole)
    heapq.heapify(part)
    order: list[Step] = []
    while whole or part:
        path = heapq.heappop(whole) if whole else heapq.heappop(part)
        now = tuple(n for n in names[path] if n in ready[path])
        if not now:
            continue
        ready[path].clear()
        left[path].difference_update(now)
        order.append((path, now))
        for name in now:
            for consumer, waiting in consumers[path, name]:
                missing[consumer, waiting] -= 1
                if not missing[consumer, waiting]:
                    ready[consumer].add(waiting)
                    heapq.heappush(whole if ready[consumer] == left[consumer] else part, consumer)
    stuck = {(path, name) for path, every in left.items() for name in every}
    if stuck:
        raise _loop_error(table, traced, waits, stuck, start)
    return order


def _loop_error(
    table: Structure, traced: Mapping[str, Traced], waits: dict[Port, set[Port]], stuck: set[Port], start: bool
) -> AlgebraicLoopError:
    """Print the loop port by port."""
    port = min(p for p in stuck if p[1] not in (NEXT, GUARDS))
    seen: list[Port] = []
    while port not in seen:
        seen.append(port)
        port = min(s for s in waits[port] if s in stuck)
    loop = seen[seen.index(port) :]
    first = loop.index(min(loop))
    loop = loop[first:] + loop[:first]
    lines = []
    for i, (path, name) in enumerate(reversed(loop)):
        source = loop[-i - 2] if i + 2 <= len(loop) else loop[-1]
        consumer_path = source[0]
        wired = [
            q
            for q in traced[consumer_path].inputs
            if (w := table.wires.get((consumer_path, q))) is not None and (w.block, w.port) == (path, name)
        ]
        inlet = wired[0] if wired else "?"
        lines.append(f"  {path}.{name} is wired to {consumer_path}.{inlet}")
        lines.append(f"  {consumer_path}.{inlet} feeds through to {consumer_path}.{source[1]}")
    what = "initial values depend on each other" if start else "these ports depend on each other within one instant"
    return AlgebraicLoopError(
        f"{what}:\n" + "\n".join(lines) + "\nBreak the loop where a delay is real: put a UnitDelay"
        f"{'(initial_value=…)' if start else ''} on one of these wires.",
        block=min(loop)[0],
    )
