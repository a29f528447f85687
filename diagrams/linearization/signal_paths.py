"""Ways of signals through a diagram: which findings lie between two ports, or on a loop."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from typing import NamedTuple

from ...blocks.core import Finding
from ..flat import FlatDiagram
from ..wiring import find_cyclic_parts
from .block_slopes import slopes_of
from .left_out_effects import BlockFinding, EventWithinPeriod, InexactDerivatives


class PathNode(NamedTuple):
    """An input or an output of a block."""

    block: str
    port: str
    is_output: bool


class SignalPaths:
    """The ways of signals: along wires, and through blocks from the inputs to the outputs that follow them.

    An output follows an input at once, by states, or by events, but none that counts at the start alone. Outputs of an
    FMU follow all its inputs; those of the blocks in an enabled or triggered subsystem follow its control.
    """

    def __init__(self, flat: FlatDiagram, cut: Iterable[tuple[str, str]] = ()):
        self.flat, self.cut = flat, frozenset(cut)

    @cached_property
    def _wires(self) -> dict[PathNode, set[PathNode]]:
        """From outputs to the inputs of their consumers, and to what a subsystem's control acts on; none is cut."""
        table = self.flat.table
        edges: dict[PathNode, set[PathNode]] = {}
        for (block, port), wire in table.wires.items():
            edges.setdefault(PathNode(wire.block, wire.port, True), set()).add(PathNode(block, port, False))
        for subsystem, wire in table.controls.items():
            inside = (p for p, s in table.subsystem_of.items() if f"{s}.".startswith(f"{subsystem}."))
            edges.setdefault(PathNode(wire.block, wire.port, True), set()).update(
                PathNode(path, port, True) for path in inside for port in table.blocks[path].outputs
            )
        return edges

    @cached_property
    def _forward(self) -> dict[PathNode, set[PathNode]]:
        traced = self.flat.checked.traced
        edges = {node: set(to) for node, to in self._wires.items() if (node.block, node.port) not in self.cut}
        for path, block in self.flat.table.blocks.items():
            for source in (name for name, port in block.inputs.items() if not port.at_start_only):
                for port in block.outputs:
                    if path not in traced or slopes_of(traced[path]).follows(port, source):
                        edges.setdefault(PathNode(path, source, False), set()).add(PathNode(path, port, True))
        return edges

    @cached_property
    def _backward(self) -> dict[PathNode, set[PathNode]]:
        found: dict[PathNode, set[PathNode]] = {}
        for node, following in self._forward.items():
            for other in following:
                found.setdefault(other, set()).add(node)
        return found

    def after(self, ports: Iterable[tuple[str, str]]) -> set[PathNode]:
        """Return the inputs and outputs that follow what the consumers of ports get."""
        return _reach(self._forward, {n for port in ports for n in self._wires.get(PathNode(*port, True), ())})

    def follow(self, port: tuple[str, str]) -> set[PathNode]:
        """Return the inputs and outputs that follow a port as far as nothing is cut."""
        return _reach(self._forward, {PathNode(*port, True)})

    def follow_input(self, block: str, port: str) -> set[PathNode]:
        """Return the outputs of a block that follow one of its inputs."""
        return self._forward.get(PathNode(block, port, False), set())

    def is_on_loop(self, *ports: tuple[str, str]) -> bool:
        """Return whether ports are on one loop: each follows what the consumers of each get."""
        return all(PathNode(*port, True) in self.after([other]) for port in ports for other in ports)

    def reach(self, start: PathNode, avoiding: Callable[[str], bool]) -> set[PathNode]:
        """Return the inputs and outputs that follow one through blocks that are not to be avoided, by their paths."""
        open_ways = {
            node: {other for other in following if not avoiding(other.block)}
            for node, following in self._forward.items()
        }
        return _reach(open_ways, {start})

    def before(self, ports: Iterable[tuple[str, str]]) -> set[PathNode]:
        """Return the ports, and the inputs and outputs that they follow."""
        return _reach(self._backward, {PathNode(*port, True) for port in ports})

    def between(
        self, findings: Iterable[Finding], sources: Iterable[tuple[str, str]], sinks: Iterable[tuple[str, str]]
    ) -> tuple[Finding, ...]:
        """Return the findings that limit what is between the wires behind ``sources`` and the ports ``sinks``."""
        after, before = self.after(sources), self.before(sinks)
        return tuple(f for f in findings if f.limits_numbers and self._is_between(f, after, before))

    def on_loops(self, findings: Iterable[Finding]) -> tuple[Finding, ...]:
        """Return the findings that limit numbers about all loops together, such as the poles."""
        return tuple(f for f in findings if f.limits_numbers and self._is_on_loop(f))

    def wires_on_loops(self) -> list[tuple[PathNode, PathNode]]:
        """Return the wires that are part of a loop, as pairs of an output and an input, in order of their paths.

        The control of a subsystem leads to the outputs of its blocks.
        """
        nodes = {*self._forward, *(node for to in self._forward.values() for node in to)}
        keys = {"\0".join((n.block, n.port, str(n.is_output))): n for n in sorted(nodes)}
        key_of = {node: key for key, node in keys.items()}
        pairs = [(key_of[a], key_of[b]) for a, to in self._forward.items() for b in to]
        part_of = {keys[key]: i for i, part in enumerate(find_cyclic_parts(list(keys), pairs)) for key in part}
        return [
            (node, other)
            for node in keys.values()
            if node.is_output and node in part_of
            for other in sorted(self._forward.get(node, ()))
            if part_of.get(other) == part_of[node]
        ]

    def _is_on_loop(self, finding: Finding) -> bool:
        ends = self._ends(finding)
        if ends is None:
            return True
        return bool(_reach(self._forward, ends[1]) & ends[0])

    def _is_between(self, finding: Finding, after: set[PathNode], before: set[PathNode]) -> bool:
        ends = self._ends(finding)
        return ends is None or bool(ends[0] & after and ends[1] & before)

    def _ends(self, finding: Finding) -> tuple[set[PathNode], set[PathNode]] | None:
        """Return the inputs and the outputs of a block that a finding concerns; None where it concerns everything."""
        kinds = BlockFinding | EventWithinPeriod | InexactDerivatives
        if not isinstance(finding, kinds) or finding.block not in self.flat.table.blocks:
            return None
        path, block = finding.block, self.flat.table.blocks[finding.block]
        inputs = {PathNode(path, port, False) for port in block.inputs}
        outputs = {PathNode(path, port, True) for port in block.outputs}
        if isinstance(finding, BlockFinding):
            inputs &= {PathNode(path, finding.source, False)} if finding.source in block.inputs else inputs
            outputs &= {PathNode(path, finding.port, True)} if finding.port in block.outputs else outputs
        return inputs, outputs


def _reach(edges: Mapping[PathNode, set[PathNode]], starts: Iterable[PathNode]) -> set[PathNode]:
    """Return the nodes that are reached from some, themselves among them."""
    found, todo = set(starts), list(starts)
    while todo:
        new = edges.get(todo.pop(), set()) - found
        found |= new
        todo += new
    return found
