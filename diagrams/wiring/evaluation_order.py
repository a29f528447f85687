"""The order of evaluation, from feedthrough between ports.

A block's outputs, its next state and its guards are ordered one by one: each waits only for the inputs that it
depends on. So a cycle in the drawing is an algebraic loop only if a port waits for itself. Where ports wait for each
other, their entries are ordered one by one (`_EntryOrder`): a loop is one only if an entry waits for itself. Blocks are
taken by path, so the order never depends on how a diagram was written down.

Where a loop is to be solved, some of its ports are *torn*: their values are taken as known. Newton's method then
finds the values that the loop gives back unchanged.
"""

from __future__ import annotations

import heapq
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...blocks.core import AlgebraicLoopError
from ...blocks.tracing import GUARDS, NEXT, Traced, size
from .structure import Structure, Wire

Port = tuple[str, str]
OrderStep = tuple[str, tuple[str, ...]]
"""A block's path, and its equations that are evaluated together: outputs by name, next state, guards."""
Entry = tuple[str, str, int]
"""A block's path, the name of an equation, and an entry of it; next state and guards have one entry."""


def dependencies(table: Structure, traced: Mapping[str, Traced], *, start: bool = False) -> dict[Port, set[Port]]:
    """Return, for every output, next state and guard, the output ports that it waits for."""
    waits: dict[Port, set[Port]] = {}
    gated = {
        s: [(w.block, w.port) for g in table.gates(s) if (w := table.controls[g]).block in traced]
        for s in table.subsystems
    }
    for path, trace in traced.items():
        # At initialization a block that computes its initial state from its inputs waits for all of them first.
        all_inputs = start and table.blocks[path].starts_from_inputs
        controls, sources = gated[table.subsystem_of[path]], dict[str, Port]()
        for port in trace.inputs:
            wire = table.wires.get((path, port))
            if wire is not None and wire.block in traced:
                sources[port] = (wire.block, wire.port)
        for name in (*trace.outputs, NEXT, GUARDS):
            inputs = trace.inputs if all_inputs else trace.depends[name]
            waits[path, name] = {*(source for port, source in sources.items() if port in inputs), *controls}
    return waits


@dataclass(frozen=True)
class Order:
    """The order of evaluation."""

    steps: list[OrderStep]
    torn: tuple[Port, ...] = ()  # output ports whose values are taken as known
    loops: tuple[str, ...] = ()  # every algebraic loop, printed port by port


def evaluation_order(
    table: Structure, traced: Mapping[str, Traced], *, start: bool = False, solve: bool = False
) -> Order:
    """Return the order of evaluation, of initialization with ``start``; ``solve`` tears algebraic loops."""
    waits = dependencies(table, traced, start=start)
    steps, stuck = _sort(traced, waits)
    if not stuck:
        return Order(steps)
    entries = _EntryOrder(table, traced, waits, stuck, start=start)
    more, within = entries.sort()
    if not within:
        return Order([*steps, *more])
    if not solve:
        raise _loop_error(table, traced, _find_loop(within, _first_output(within)), start)
    torn: set[Port] = set()
    loops: list[str] = []
    for loop, port in _tear(traced, within):
        torn.add(port)
        loops.append("\n".join(_write_loop(table, traced, loop)))
    return Order([*steps, *entries.sort(torn)[0]], tuple(sorted(torn)), tuple(loops))


def find_orders(table: Structure, traced: Mapping[str, Traced], *, solve: bool = False) -> tuple[Order, Order]:
    """Return the orders of evaluation at an instant, and of initialization; see `evaluation_order`."""
    order = evaluation_order(table, traced, solve=solve)
    if not any(table.blocks[path].starts_from_inputs for path in traced):
        return order, order
    return order, evaluation_order(table, traced, start=True, solve=solve)


def _tear(traced: Mapping[str, Traced], within: Mapping[Port, set[Port]]) -> Iterator[tuple[list[Port], Port]]:
    """Yield loop after loop among the ports that are stuck, each with the port to tear."""
    waits = {port: set(sources) for port, sources in within.items()}
    consumers: dict[Port, list[Port]] = defaultdict(list)
    for port, sources in waits.items():
        for source in sources:
            consumers[source].append(port)
    candidates = sorted((p for p in waits if p[1] not in (NEXT, GUARDS)), reverse=True)
    while candidates:
        if not waits[candidates[-1]]:
            candidates.pop()
            continue
        loop = _find_loop(waits, candidates[-1])
        sizes = {port: math.prod(traced[port[0]].outputs[port[1]]) for port in loop}
        torn = min(loop, key=lambda port: (sizes[port], port))
        yield loop, torn
        known = [torn]
        while known:
            source = known.pop()
            for port in consumers.pop(source, ()):
                waits[port].discard(source)
                if not waits[port]:
                    known.append(port)


def _sort(traced: Mapping[str, Traced], waits: Mapping[Port, set[Port]]) -> tuple[list[OrderStep], set[Port]]:
    """Return the steps that can be evaluated, in order, and the ports that are stuck in or behind loops."""
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
    order: list[OrderStep] = []
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
    return order, {(path, name) for path, every in left.items() for name in every}


def _first_output(ports: Iterable[Port]) -> Port:
    """Return the first port that is an output."""
    return min(p for p in ports if p[1] not in (NEXT, GUARDS))


def _find_loop(waits: Mapping[Port, set[Port]], port: Port) -> list[Port]:
    """Follow the waiting from a stuck port until it closes, and return that loop's ports, each waiting for the next."""
    seen: dict[Port, int] = {}
    while port not in seen:
        seen[port] = len(seen)
        port = min(waits[port])
    loop = list(seen)[seen[port] :]
    first = loop.index(min(loop))
    return loop[first:] + loop[:first]


def _write_loop(table: Structure, traced: Mapping[str, Traced], loop: list[Port]) -> list[str]:
    """Write a loop port by port, as lines."""
    lines = []
    for i, (path, name) in enumerate(reversed(loop)):
        source = loop[-i - 2] if i + 2 <= len(loop) else loop[-1]
        consumer_path = source[0]
        wired = [
            q
            for q in traced[consumer_path].inputs
            if (w := table.wires.get((consumer_path, q))) is not None and (w.block, w.port) == (path, name)
        ]
        through = [q for q in wired if q in traced[consumer_path].depends[source[1]]] or wired
        if through:
            lines.append(f"  {path}.{name} is wired to {consumer_path}.{through[0]}")
            lines.append(f"  {consumer_path}.{through[0]} feeds through to {consumer_path}.{source[1]}")
            continue
        gates = table.gates(table.subsystem_of[consumer_path])
        gate = next((g for g in gates if (table.controls[g].block, table.controls[g].port) == (path, name)), "?")
        lines.append(f"  {path}.{name} controls the subsystem {gate}")
        lines.append(f"  {gate} acts on {consumer_path}.{source[1]}")
    return lines


def _loop_error(table: Structure, traced: Mapping[str, Traced], loop: list[Port], start: bool) -> AlgebraicLoopError:
    advice = ", or have it solved at every instant: Diagram(…, loops='solve')"
    found, delay = "these ports depend on each other within one instant", "UnitDelay"
    if start:
        found, delay = "initial values depend on each other", "UnitDelay(initial_value=…)"
    return AlgebraicLoopError(
        f"{found}:\n" + "\n".join(_write_loop(table, traced, loop)) + f"\nBreak the loop where a delay is real: put a "
        f"{delay} on one of these wires{'' if start else advice}.",
        block=min(loop)[0],
    )


class _EntryOrder:
    """Order of the entries of ports that are stuck in or behind loops of ports, where no entry waits for itself.

    A state space with several inputs whose D is sparse, for example, gives y[0] from u[1] at once, and not from u[0].
    Such a port is evaluated several times: first for the entries whose inputs are there, with any numbers in the place
    of others, and again when more inputs are there. An entry keeps its value, since the inputs that it depends on do.
    """

    def __init__(
        self,
        table: Structure,
        traced: Mapping[str, Traced],
        waits: Mapping[Port, set[Port]],  # the ports that each output, next state and guard waits for
        stuck: set[Port],
        *,
        start: bool,  # whether it is the order of initialization
    ):
        self.table, self.traced, self.stuck = table, traced, stuck
        self.waits: dict[Entry, set[Entry]] = {}
        for path, name in sorted(stuck):
            whole = start and table.blocks[path].starts_from_inputs
            self._add(path, name, waits[path, name], whole=whole)

    def sort(self, torn: Iterable[Port] = ()) -> tuple[list[OrderStep], dict[Port, set[Port]]]:
        """Return the steps that can be evaluated, in order, and for each port that is still stuck what it waits for."""
        known = set(torn)  # the values of these ports are taken as known
        waits = {entry: {s for s in sources if s[:2] not in known} for entry, sources in self.waits.items()}
        missing = {entry: len(sources) for entry, sources in waits.items()}
        consumers: dict[Entry, list[Entry]] = defaultdict(list)
        left: dict[str, int] = defaultdict(int)
        ready: dict[str, list[Entry]] = defaultdict(list)
        for entry in sorted(waits):
            left[entry[0]] += 1
            for source in waits[entry]:
                consumers[source].append(entry)
            if not missing[entry]:
                ready[entry[0]].append(entry)
        whole = [path for path in ready if len(ready[path]) == left[path]]
        part = [*ready]
        heapq.heapify(whole)
        heapq.heapify(part)
        steps: list[OrderStep] = []
        while whole or part:
            path = heapq.heappop(whole) if whole else heapq.heappop(part)
            now = ready.pop(path, [])
            if not now:
                continue
            left[path] -= len(now)
            names = {name for _, name, _ in now}
            steps.append((path, tuple(n for n in (*self.traced[path].outputs, NEXT, GUARDS) if n in names)))
            for entry in now:
                for consumer in consumers[entry]:
                    missing[consumer] -= 1
                    if not missing[consumer]:
                        owner = consumer[0]
                        ready[owner].append(consumer)
                        heapq.heappush(whole if len(ready[owner]) == left[owner] else part, owner)
        within: dict[Port, set[Port]] = {}
        for entry, count in missing.items():
            if count > 0:
                sources = {source[:2] for source in waits[entry] if missing[source] > 0}
                within.setdefault(entry[:2], set()).update(sources)
        return steps, within

    def _add(self, path: str, name: str, ports: set[Port], *, whole: bool) -> None:
        """Add the entries of an equation, each with those that it waits for."""
        trace = self.traced[path]
        count = size(trace.outputs[name]) if name in trace.outputs else 1
        found: list[set[Entry]] = [set() for _ in range(count)]
        wired: set[Port] = set()
        for place, port in enumerate(trace.inputs):
            wire = self.table.wires.get((path, port))
            if wire is None or (wire.block, wire.port) not in ports & self.stuck:
                continue
            if name not in trace.outputs or whole:
                continue  # it waits for the whole port, below
            wired.add((wire.block, wire.port))
            columns = self._entries(wire)
            pattern = trace.function.jac_sparsity([*trace.outputs].index(name), 2 + place)
            for row, column in zip(*pattern.get_triplet(), strict=True):
                found[row].add((wire.block, wire.port, int(columns[column])))
        controls = {(w.block, w.port) for w in map(self.table.controls.get, self._gates(path)) if w is not None}
        for block, output in (ports & self.stuck) - (wired - controls):
            shape = self.traced[block].outputs[output]
            for waiting in found:
                waiting.update((block, output, e) for e in range(size(shape)))
        self.waits |= {(path, name, e): waiting for e, waiting in enumerate(found)}

    def _gates(self, path: str) -> Iterable[str]:
        return self.table.gates(self.table.subsystem_of[path])

    def _entries(self, wire: Wire) -> Any:
        """Return the entries of its port that a wire takes, in their order."""
        return np.ravel(wire.entries(self.traced[wire.block].outputs[wire.port]))


def find_cyclic_parts(keys: Sequence[str], pairs: Iterable[tuple[str, str]]) -> list[set[str]]:
    """Return the strongly connected parts of a graph that have a cycle, in the order of their first nodes."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    place = {key: i for i, key in enumerate(keys)}
    edges = sorted(
        {(place[a], place[b]) for a, b in pairs}
    )  # each once: SciPy 1.13.0 is wrong or hangs with repeated ones
    if not edges:
        return []
    rows, columns = zip(*edges, strict=True)
    graph = csr_matrix((np.ones(len(edges)), (rows, columns)), shape=(len(place), len(place)))
    _, labels = connected_components(graph, directed=True, connection="strong")
    own = {a for a, b in edges if a == b}
    parts: dict[int, set[str]] = {}
    for key, i in place.items():
        parts.setdefault(int(labels[i]), set()).add(key)
    return [part for part in parts.values() if len(part) > 1 or place[min(part)] in own]
