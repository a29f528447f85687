"""Wires with several ways back: to the plant, and within the controller itself.

A Smith predictor or an observer feeds the plant's input to its model of the plant as well. A cut of the wire behind its
port separates both from it. The loop at the plant's input is that of a cut ahead of the plant alone.

A wire acts on the blocks with states that it leads to through blocks without states, such as a saturation: these
inputs are its entries. The controller's own are, by what blocks and the structure say,

- inputs that are declared so: those that track an output, and those of a model of the plant (`Observer.u`);
- those from which the wire is reached again within a subsystem that the wire comes from and also leaves, or, where a
  sampled wire also acts on blocks in continuous time, through sampled blocks alone;
- those that an FMU leads to, which the wire drives as well, if the way from them back to the wire avoids all FMUs.

A wire that enters a sampled subsystem, and acts nowhere else, is one signal for all that is in it, as an error is for
the parts of a PI law: no cut is made ahead of one of them. Nor is one where what is in continuous time puts a wire out
and sampled blocks alone read it: that is a measurement, such as the angle that two loops of a drive follow.

Where this leaves several entries, parallel parts of a plant can't be distinguished from a plant and a model of it, as
their graphs are the same: the cuts ahead of each are then as possible as that for all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from ...blocks.core import Finding
from ..flat import FlatDiagram
from ..wiring import join
from .left_out_effects import ParallelWays, SharedCut
from .signal_paths import PathNode, SignalPaths

Port = tuple[str, str]
MOST = 6
"""Blocks at most whose inputs are looked at one by one, where any of them may be the plant's."""


@dataclass(frozen=True)
class CutAhead:
    """A cut ahead of some consumers of a port."""

    port: Port
    to: tuple[Port, ...] = ()  # the consumers; empty for all of them


@dataclass(frozen=True)
class WaysBack:
    """The consumers of a wire that lead back to it."""

    plant: tuple[Port, ...]  # inputs of the plant, or all of them where none is the controller's own
    own: tuple[Port, ...]  # inputs by which the wire's source comes back to itself without the plant
    # port whose consumers the plant's inputs are: the wire's, or one behind blocks without states that it feeds
    port: Port
    others: tuple[CutAhead, ...] = ()  # further cuts that nothing excludes, where several blocks may be the plant
    is_separable: bool = True  # whether one cut separates the plant's inputs from the controller's own


def find_ways_back(flat: FlatDiagram, port: Port) -> WaysBack:
    """Return the consumers of a port that lead back to it, those of the controller itself apart."""
    search = _WaysFrom(flat, port)
    every = search.consumers(port)
    entries = search.entries(port)
    declared = [to for to in entries if _is_declared(flat, to)]
    plant = [to for to in entries if to not in declared]
    if not plant:
        return WaysBack(every, (), port)
    own, inner = list(declared), set[Port]()
    for is_outside in _borders(flat, port[0]):
        within = search.entries(port, avoiding=is_outside)
        inside = [to for to in plant if to in within]
        if len(inside) == len(plant):
            continue
        inner.update(inside)
        leading = [to for to in inside if search.leads_back(to, is_outside)]
        own += leading
        plant = [to for to in plant if to not in leading]
    behind = search.behind_fmus(plant)
    own += behind
    plant = [to for to in plant if to not in behind]
    possible = dict[str, list[Port]]()
    for to in plant:
        if to not in inner:
            possible.setdefault(to[0], []).append(to)
    consumers = search.consumers(parting := search.parting(port))
    is_one = _enters_as_one(flat, parting, consumers) or _is_measurement(flat, port, consumers)
    is_parted = 1 < len(possible) <= MOST and not is_one
    alone = [search.cut(port, inputs) for inputs in possible.values()] if is_parted else []
    found = tuple(sorted((cut for cut in alone if cut is not None), key=lambda cut: cut.to))
    if not own:
        return WaysBack(every, (), port, found)
    cut = search.cut(port, plant)
    if cut is None:
        return WaysBack(tuple(plant), tuple(sorted(own)), port, found, is_separable=False)
    left = search.left_out(port, cut)
    return WaysBack(cut.to, left, cut.port, tuple(one for one in found if one != cut))


class _WaysFrom:
    """The ways from a port back to it."""

    def __init__(self, flat: FlatDiagram, port: Port):
        self.flat, self.paths = flat, SignalPaths(flat, [port])
        self.port, self.back = port, self.paths.before([port])

    def consumers(self, port: Port) -> tuple[Port, ...]:
        """Return the consumers of a port that lead back, in order of their paths."""
        wires = self.flat.table.wires.items()
        return tuple(
            sorted(to for to, wire in wires if (wire.block, wire.port) == port and PathNode(*to, False) in self.back)
        )

    def entries(self, port: Port, avoiding: Callable[[str], bool] = lambda block: False) -> tuple[Port, ...]:
        """Return the inputs of blocks with states that a port leads to through blocks without, and that lead back.

        Those of the port's own block end a way, too.
        """
        found, seen, waiting = set[Port](), {port}, [port]
        while waiting:
            for block, name in self.consumers(waiting.pop()):
                if avoiding(block):
                    continue
                if self._ends_at(block):
                    found.add((block, name))
                else:
                    following = self._outputs(block, name)
                    waiting += [one for one in following if one not in seen]
                    seen.update(following)
        return tuple(sorted(found))

    def leads_back(self, to: Port, avoiding: Callable[[str], bool]) -> bool:
        """Return whether the port is reached from an input through blocks that are not to be avoided."""
        return PathNode(*self.port, True) in self.paths.reach(PathNode(*to, False), avoiding)

    def parting(self, port: Port) -> Port:
        """Return the port at which the ways from one part: itself, or one behind blocks without states."""
        consumers = self.consumers(port)
        if len(consumers) == 1 and not self._ends_at(consumers[0][0]):
            following = self._outputs(*consumers[0])
            if len(following) == 1:
                return self.parting(following[0])
        return port

    def behind_fmus(self, entries: Sequence[Port]) -> list[Port]:
        """Return the entries that an FMU among them leads to, if they lead back without an FMU, as an observer does."""

        def is_fmu(block: str) -> bool:
            return _is_fmu(self.flat, block)

        driven = [to for to in entries if is_fmu(to[0])]
        others = [to for to in entries if not is_fmu(to[0])]
        if not driven or is_fmu(self.port[0]):
            return []
        after = {block for to in driven for block in self._on_ways_back(to)}
        behind = [to for to in others if to[0] in after and self.leads_back(to, is_fmu)]
        return [to for to in behind if not any(is_fmu(block) for block in self._on_ways_back(to))]

    def _on_ways_back(self, to: Port) -> set[str]:
        """Return the blocks on the ways from an input back to the port."""
        return {n.block for n in self.paths.reach(PathNode(*to, False), lambda block: False) & self.back}

    def cut(self, port: Port, entries: Sequence[Port]) -> CutAhead | None:
        """Return the cut of a port, or of one behind it, that separates some entries from the others.

        None where no single one does.
        """
        wanted, only, both = set(entries), list[Port](), list[Port]()
        for to in self.consumers(port):
            reached = {to} if self._ends_at(to[0]) else {e for o in self._outputs(*to) for e in self.entries(o)}
            if reached and reached <= wanted:
                only.append(to)
            elif reached & wanted:
                both.append(to)
        if not both:
            return CutAhead(port, tuple(only)) if only else None
        following = self._outputs(*both[0])
        return self.cut(following[0], entries) if not only and len(both) == len(following) == 1 else None

    def left_out(self, port: Port, cut: CutAhead) -> tuple[Port, ...]:
        """Return the consumers that lead back and that a cut leaves closed, from a port on to the cut's."""
        found = list[Port]()
        while port != cut.port:
            consumers = self.consumers(port)
            through = next(to for to in consumers if not self._ends_at(to[0]) and self._is_before(to, cut.port))
            found += [to for to in consumers if to != through]
            port = self._outputs(*through)[0]
        return tuple(sorted([*found, *(to for to in self.consumers(port) if to not in cut.to)]))

    def _is_before(self, to: Port, port: Port) -> bool:
        """Return whether an input leads to a port through blocks without states."""
        seen, waiting = set[Port](), [to]
        while waiting:
            for one in self._outputs(*waiting.pop()):
                if one == port:
                    return True
                if one not in seen:
                    seen.add(one)
                    waiting += [consumer for consumer in self.consumers(one) if not self._ends_at(consumer[0])]
        return False

    def _ends_at(self, block: str) -> bool:
        return block == self.port[0] or _is_dynamic(self.flat, block)

    def _outputs(self, block: str, port: str) -> tuple[Port, ...]:
        """Return the outputs that follow an input of a block, and lead back."""
        following = self.paths.follow_input(block, port)
        return tuple(sorted((n.block, n.port) for n in following if n in self.back))


def _is_declared(flat: FlatDiagram, to: Port) -> bool:
    """Return whether an input is declared as the controller's own: one that tracks, or a model's."""
    port = flat.table.blocks[to[0]].inputs[to[1]]
    return port.tracks is not None or port.models_plant


def _is_fmu(flat: FlatDiagram, path: str) -> bool:
    block = flat.table.blocks[path]
    return bool(block.stepped or block.in_model_exchange)


def _enters_as_one(flat: FlatDiagram, port: Port, consumers: Sequence[Port]) -> bool:
    """Return whether all consumers are in one sampled subsystem that the port is not in."""
    table = flat.table

    def around(block: str) -> list[str]:
        subsystem = table.subsystem_of[block]
        return [f for f in table.subsystems if f"{subsystem}.".startswith(f"{f}.") and table.clock(f) is not None]

    common = set.intersection(*(set(around(block)) for block, _ in consumers)) if consumers else set()
    return bool(common.difference(around(port[0])))


def _is_measurement(flat: FlatDiagram, port: Port, consumers: Sequence[Port]) -> bool:
    """Return whether a plant in continuous time puts it out, and sampled blocks alone read it."""
    if _is_sampled(flat, port[0]) or not _is_dynamic(flat, port[0]) or not consumers:
        return False
    return all(_is_sampled(flat, block) for block, _ in consumers)


def _is_sampled(flat: FlatDiagram, block: str) -> bool:
    return not _is_fmu(flat, block) and flat.table.clock(flat.table.subsystem_of[block]) is not None


def _borders(flat: FlatDiagram, source: str) -> Iterator[Callable[[str], bool]]:
    """Yield functions that return whether a block is outside the controller, if that is what a border around it says.

    The borders are the subsystems of the source, from the innermost on, and that between sampled and continuous blocks.
    """
    table = flat.table
    subsystem = table.subsystem_of[source]
    while subsystem:
        yield lambda block, frame=f"{subsystem}.": not f"{table.subsystem_of[block]}.".startswith(frame)  # type: ignore[misc]
        subsystem = subsystem.rpartition(".")[0]
    if _is_sampled(flat, source):
        yield lambda block: not _is_sampled(flat, block)


def find_shared_cuts(flat: FlatDiagram, cut: Iterable[Port], name: Callable[[Port], str]) -> tuple[Finding, ...]:
    """Return the findings about cut wires with several ways back; ``name`` names the wire behind a port.

    Inputs that track an output are left out: another finding names them.
    """
    found: list[Finding] = []
    blocks = flat.table.blocks
    for port in dict.fromkeys(cut):
        ways = find_ways_back(flat, port)
        own = tuple(to for to in ways.own if blocks[to[0]].inputs[to[1]].tracks is None)
        if own:
            to, at = tuple(join(*to) for to in ways.plant), "" if ways.port == port else name(ways.port)
            inputs = tuple(join(*to) for to in own)
            found.append(SharedCut(name(port), to if ways.is_separable else (), inputs, at))
        elif not ways.own and ways.others:
            cuts = tuple((name(one.port), tuple(join(*to) for to in one.to)) for one in ways.others)
            found.append(ParallelWays(name(port), cuts))
    return tuple(found)


def _is_dynamic(flat: FlatDiagram, path: str) -> bool:
    return bool(flat.table.blocks[path].states) or _is_fmu(flat, path)
