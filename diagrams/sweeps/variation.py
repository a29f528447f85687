"""From a sample to the numbers of its run: parameters that are numbers change nothing else in a diagram."""

from __future__ import annotations

import copy
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np

from ...blocks.core import Block, LoopwrightError, identity
from ...blocks.tracing import structure
from ...fmus import Fmu
from ...fmus.archive import FmuDescription
from ..flat import FlatDiagram
from ..simulation import SimulatedDiagram
from ..wiring import change_parameter, split_path

D = TypeVar("D", bound=SimulatedDiagram)
_KEPT = 8
"""Diagrams of other structure that are kept at a time."""


@dataclass(frozen=True, eq=False)
class Numbers(Generic[D]):
    """A sample as numbers of a diagram.

    Attributes
    ----------
    diagram : Diagram
        The diagram whose functions the run takes.
    key : object
        Which diagram that is: equal keys, equal functions.
    blocks : mapping of str to Block
        Blocks of other parameters, by path.
    starts : mapping of str to mapping
        Start values of FMUs, checked, by the block's path and the FMU's names.
    """

    diagram: D
    key: Any
    blocks: Mapping[str, Block] = field(default_factory=dict)
    starts: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def flatten(self, flat: FlatDiagram) -> FlatDiagram:
        """Return the flattened diagram with these numbers; it shares the functions of ``flat``, that of `diagram`."""
        if not self.blocks:
            return flat
        found, table = copy.copy(flat), flat.table.copy()
        table.blocks.update(self.blocks)
        p, x0 = flat.p.copy(), flat.x0.copy()
        for path, block in self.blocks.items():
            p[flat.parameters.slices[path]] = flat.pack(path, block)
            inputs = flat.checked.traced[path].inputs
            values = [np.ravel(port.start_value(block, inputs)) for port in block.states.values()]
            if values:
                x0[flat.states.slices[path]] = np.concatenate(values)
        for name, value in (("table", table), ("p", p), ("x0", x0)):
            object.__setattr__(found, name, value)
        return found


class Variation(Generic[D]):
    """Finds the numbers of samples.

    Parameters
    ----------
    diagram : Diagram
        The diagram that is varied.
    """

    def __init__(self, diagram: D):
        self._diagram = diagram
        self._others: OrderedDict[Any, D] = OrderedDict()
        self._places: dict[str, tuple[str, list[str]] | None] = {}
        self._descriptions: dict[str, FmuDescription] = {}

    def apply(self, parameters: Mapping[str, Any]) -> D:
        """Return the diagram with the parameters of a sample."""
        return self._diagram.replace(parameters) if parameters else self._diagram

    def find(self, parameters: Mapping[str, Any]) -> Numbers[D]:
        """Return the numbers of a sample.

        Raises
        ------
        LoopwrightError
            A value that a parameter does not take.
        """
        other: dict[str, Any] = {}
        blocks: dict[str, Block] = {}
        names: dict[str, list[str]] = {}
        starts: dict[str, dict[str, Any]] = {}
        scheduled = self._diagram.scheduled.blocks
        for name, value in parameters.items():
            place = self._place(name)
            if place is None or isinstance(value, Block):
                other[name] = value
                continue
            path, keys = place
            block = scheduled[path]
            if isinstance(block, Fmu):
                starts.setdefault(path, {})[keys[1]] = block.start_value(self._about(path, block), keys[1], value)
            else:
                blocks[path] = change_parameter(blocks.get(path, block), keys, value)
                names.setdefault(path, []).append(name)
        for path in [path for path, block in blocks.items() if not self._is_numbers(path, block)]:
            other |= {name: parameters[name] for name in names[path]}
            del blocks[path]
        if not other:
            return Numbers(self._diagram, None, blocks, starts)
        key = frozenset((name, identity(value)) for name, value in other.items())
        if key not in self._others:
            self._others[key] = self._diagram.replace(other)
            while len(self._others) > _KEPT:
                self._others.popitem(last=False)
        self._others.move_to_end(key)
        return Numbers(self._others[key], key, blocks, starts)

    def _about(self, path: str, block: Fmu) -> FmuDescription:
        """Return an FMU's description; its file is looked at once."""
        if path not in self._descriptions:
            self._descriptions[path] = block.description
        return self._descriptions[path]

    def _place(self, name: str) -> tuple[str, list[str]] | None:
        """Return the block and the names within it of a parameter that may be a number; None where it changes more."""
        if name not in self._places:
            self._places[name] = self._find_place(name)
        return self._places[name]

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
            about = block.description
            name = ".".join(keys[1:])
            plain = keys[0] == "start" and name in about.variables and not about.structural
            return (path, ["start", name]) if plain and not _has_elements(block, name) else None
        return (path, keys) if path in diagram.checked.traced and keys[0] in type(block).parameter_specs else None

    def _is_numbers(self, path: str, block: Block) -> bool:
        """Whether a block differs from that of the diagram in numbers alone: its functions are those of that."""
        old, wires = self._diagram.scheduled.blocks[path], self._diagram.scheduled.wires
        if structure(block) != structure(old):
            return False
        free = [port for port in old.inputs if (path, port) not in wires]
        return all(identity(block.inputs[q].default) == identity(old.inputs[q].default) for q in free)


def _has_elements(block: Fmu, name: str) -> bool:
    """Whether start values name elements of an array, which are merged with those of the array."""
    about = block.description
    return any(about.elements[given][0] == name for given in block.start if given in about.elements)
