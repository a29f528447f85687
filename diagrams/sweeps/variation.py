"""From a sample to the numbers of its run: parameters that are numbers change nothing else in a diagram."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ...blocks.core import Block, LoopwrightError, identity
from ...blocks.tracing import has_structure
from ...fmus import Fmu
from ...fmus.archive import FmuDescription
from ..flat import WiredDiagram
from ..wiring import change_parameters, split_entry, split_path

_KEPT = 8
"""Diagrams of other structure that are kept at a time."""


@dataclass(frozen=True, eq=False)
class Numbers:
    """A sample as numbers of a diagram."""

    diagram: WiredDiagram  # whose functions the run takes
    key: Any  # equal keys, equal functions
    blocks: Mapping[str, Block] = field(default_factory=dict)  # of other parameters, by path
    starts: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # of FMUs, by the block's path and name

    def make_diagram(self) -> WiredDiagram:
        """Return the diagram with these numbers; it shares the functions of `diagram`."""
        plants = {path: self._start_with(path, values) for path, values in self.starts.items()}
        return self.diagram.renumbered({**self.blocks, **plants}) if self.blocks or plants else self.diagram

    def _start_with(self, path: str, values: Mapping[str, Any]) -> Fmu:
        block = self.diagram.scheduled.blocks[path]
        assert isinstance(block, Fmu)
        return block.replace(start={**block.start, **values})


class Variation:
    """Finds the numbers of samples of a diagram that is varied."""

    def __init__(self, diagram: WiredDiagram):
        self._diagram = diagram
        self._others: OrderedDict[Any, WiredDiagram] = OrderedDict()
        self._places: dict[str, tuple[str, list[str]] | None] = {}
        self._free: dict[str, list[str]] = {}
        self._descriptions: dict[str, FmuDescription] = {}

    def find(self, parameters: Mapping[str, Any]) -> Numbers:
        """Return the numbers of a sample."""
        other: set[str] = set()
        blocks: dict[str, Block] = {}
        starts: dict[str, dict[str, Any]] = {}
        names: dict[str, list[str]] = {}
        changes: dict[str, list[tuple[list[str], Any]]] = {}
        scheduled = self._diagram.scheduled.blocks
        for name, value in parameters.items():
            place = self.place(name)
            if place is None or isinstance(value, Block):
                other.add(name)
                continue
            path, keys = place
            block = scheduled[path]
            if isinstance(block, Fmu):
                starts.setdefault(path, {})[keys[1]] = block.start_value(self._about(path, block), keys[1], value)
            else:
                changes.setdefault(path, []).append((keys, value))
            names.setdefault(path, []).append(name)
        for path, of_it in changes.items():
            blocks[path] = change_parameters(scheduled[path], of_it)
        changed = {path for path, block in blocks.items() if not self._is_numbers(path, block)}
        for path in changed | ({self._owner(name) for name in other} & names.keys() if other else set()):
            other.update(names[path])
            blocks.pop(path, None)
            starts.pop(path, None)
        if not other:
            return Numbers(self._diagram, None, blocks, starts)
        structural = {name: value for name, value in parameters.items() if name in other}  # in their order
        key = tuple((name, identity(value)) for name, value in structural.items())
        if key not in self._others:
            self._others[key] = self._diagram.replace(structural)
            while len(self._others) > _KEPT:
                self._others.popitem(last=False)
        self._others.move_to_end(key)
        return Numbers(self._others[key], key, blocks, starts)

    def _about(self, path: str, block: Fmu) -> FmuDescription:
        """Return an FMU's description; its file is looked at once."""
        if path not in self._descriptions:
            self._descriptions[path] = block.description
        return self._descriptions[path]

    def place(self, name: str) -> tuple[str, list[str]] | None:
        """Return the block and the names within it of a parameter that may be a number; None where it changes more."""
        if name not in self._places:
            self._places[name] = self._find_place(name)
        return self._places[name]

    def _owner(self, name: str) -> str:
        """Return the path of the block that a name belongs to, or is; empty for a subsystem's setting."""
        if name in self._diagram.structure.blocks:
            return name
        try:
            return split_path(self._diagram.structure, name, self._diagram.name)[0]
        except LoopwrightError:
            return ""

    def _find_place(self, name: str) -> tuple[str, list[str]] | None:
        diagram = self._diagram
        try:
            path, keys = split_path(diagram.structure, name, diagram.name)
        except LoopwrightError:
            return None
        block = diagram.structure.blocks[path]
        if diagram.scheduled.blocks.get(path) is not block:
            return None
        if isinstance(block, Fmu):
            if not block.stepped:
                return None
            about = block.description
            name = ".".join(keys[1:])
            plain = keys[0] == "start" and name in about.variables and not about.structural
            return (path, ["start", name]) if plain and not _has_elements(block, name) else None
        known = split_entry(keys[0], type(block).parameter_specs)[0] in type(block).parameter_specs
        return (path, keys) if path in diagram.checked.traced and known else None

    def _is_numbers(self, path: str, block: Block) -> bool:
        """Whether a block differs from that of the diagram in numbers alone: its functions are those of that."""
        old, wires = self._diagram.scheduled.blocks[path], self._diagram.scheduled.wires
        if block.opaque or not has_structure(block, old):
            return False
        if path not in self._free:
            self._free[path] = [port for port in old.inputs if (path, port) not in wires]
        free = self._free[path]
        return not free or all(identity(block.inputs[q].default) == identity(old.inputs[q].default) for q in free)


def _has_elements(block: Fmu, name: str) -> bool:
    """Whether start values name elements of an array, which are merged with those of the array."""
    about = block.description
    return any(about.elements[given][0] == name for given in block.start if given in about.elements)


def is_number(diagram: WiredDiagram, path: str) -> bool:
    """Whether a parameter of a block changes numbers of a run alone, though it is no float, such as a noise's seed."""
    place = Variation(diagram).place(path)
    return place is not None and place[1][0] in type(diagram.scheduled.blocks[place[0]]).computed_from
