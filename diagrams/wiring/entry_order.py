"""The order of evaluation of ports that wait for each other, though none of their entries waits for itself.

A state space with several inputs whose D is sparse, for example, gives y[0] from u[1] at once, and not from u[0]. Such
a port is evaluated several times: first for the entries whose inputs are there, with any numbers in the place of
others, and again when more inputs are there. An entry keeps its value, since the inputs that it depends on do.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ...blocks.tracing import GUARDS, NEXT, Traced, size
from .structure import Structure, Wire

Port = tuple[str, str]
OrderStep = tuple[str, tuple[str, ...]]
"""A block's path, and its equations that are evaluated together: outputs by name, next state, guards."""
Entry = tuple[str, str, int]
"""A block's path, the name of an equation, and an entry of it; next state and guards have one entry."""


class EntryOrder:
    """Order of the entries of ports that are stuck in or behind loops of ports."""

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
