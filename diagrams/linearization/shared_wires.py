"""Wires with several ways back: to the plant, and within the controller itself.

A Smith predictor or an observer feeds the plant's input to a model of its own as well. A cut of the wire behind its
port separates both from it. The loop at the plant's input is that of a cut ahead of the plant alone.

Which consumers are the plant's is read from the structure. The controller's own are those from which the wire is
reached again within a subsystem that the wire comes from and also leaves, or, where a sampled wire also feeds blocks in
continuous time, through sampled blocks alone; and inputs that track an output. Where this separates none of them, the
consumers are equals: the parallel parts of a plant look like a plant and its model.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from ...blocks.core import Finding
from ..flat import FlatDiagram
from ..wiring import join
from .findings import ParallelWays, SharedCut
from .signal_paths import PathNode, SignalPaths

Port = tuple[str, str]


@dataclass(frozen=True)
class WaysBack:
    """The consumers of a wire that lead back to it.

    Attributes
    ----------
    plant : tuple of (str, str)
        Inputs of the plant, or all of them where none is the controller's own.
    own : tuple of (str, str)
        Inputs by which the wire's source comes back to itself without the plant.
    """

    plant: tuple[Port, ...]
    own: tuple[Port, ...] = ()


def find_ways_back(flat: FlatDiagram, port: Port) -> WaysBack:
    """Return the consumers of a port that lead back to it, those of the controller itself apart."""
    consumers = [to for to, wire in flat.table.wires.items() if (wire.block, wire.port) == port]
    if len(consumers) < 2:
        return WaysBack(tuple(consumers))
    paths = SignalPaths(flat, [port])
    back = paths.before([port])
    every, blocks = sorted(to for to in consumers if PathNode(*to, False) in back), flat.table.blocks
    own = [to for to in every if blocks[to[0]].inputs[to[1]].tracks is not None]
    plant = [to for to in every if to not in own]
    if not plant:
        return WaysBack(tuple(every))
    for is_outside in _borders(flat, port[0]):
        if len(plant) > 1 and any(is_outside(block) for block, _ in plant):
            inside = [to for to in plant if not is_outside(to[0])]
            inside = [to for to in inside if PathNode(*port, True) in paths.reach(PathNode(*to, False), is_outside)]
            own += inside
            plant = [to for to in plant if to not in inside]
    return WaysBack(tuple(plant), tuple(sorted(own)))


def _borders(flat: FlatDiagram, source: str) -> Iterator[Callable[[str], bool]]:
    """Yield functions that return whether a block is outside the controller, if that is what a border around it says.

    The borders are the subsystems of the source, from the innermost on, and that between sampled and continuous blocks.
    """
    table = flat.table

    def is_sampled(block: str) -> bool:
        plain = not table.blocks[block].stepped and not table.blocks[block].evaluated_outside
        return plain and table.clock(table.subsystem_of[block]) is not None

    subsystem = table.subsystem_of[source]
    while subsystem:
        yield lambda block, frame=f"{subsystem}.": not f"{table.subsystem_of[block]}.".startswith(frame)  # type: ignore[misc]
        subsystem = subsystem.rpartition(".")[0]
    if is_sampled(source):
        yield lambda block: not is_sampled(block)


def find_shared_cuts(flat: FlatDiagram, cut: Iterable[Port], name: Callable[[Port], str]) -> tuple[Finding, ...]:
    """Return the findings about cut wires with several ways back; ``name`` names the wire behind a port.

    Inputs that track an output are left out: they have a finding of their own.
    """
    found: list[Finding] = []
    blocks = flat.table.blocks
    for port in dict.fromkeys(cut):
        ways = find_ways_back(flat, port)
        own = tuple(to for to in ways.own if blocks[to[0]].inputs[to[1]].tracks is None)
        if own:
            found.append(SharedCut(name(port), tuple(join(*to) for to in ways.plant), tuple(join(*to) for to in own)))
        elif not ways.own and _are_apart(flat, port, ways.plant):
            found.append(ParallelWays(name(port), tuple(join(*to) for to in ways.plant)))
    return tuple(found)


def _are_apart(flat: FlatDiagram, port: Port, consumers: Sequence[Port]) -> bool:
    """Return whether a block with states is on the way back from a consumer of a port, and not on that from another."""
    if len({block for block, _ in consumers}) < 2:
        return False
    paths = SignalPaths(flat, [port])
    back = paths.before([port])
    ways = [{n.block for n in paths.reach(PathNode(*to, False), lambda block: False) & back} for to in consumers]
    return any(_is_dynamic(flat, block) for block in set[str]().union(*ways) - set[str].intersection(*ways))


def _is_dynamic(flat: FlatDiagram, path: str) -> bool:
    block = flat.table.blocks[path]
    return bool(block.states or block.stepped or block.evaluated_outside)
