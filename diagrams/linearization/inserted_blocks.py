"""Blocks inserted ahead of inputs, which pass the signal on: places of a linear model that no port has.

An input port becomes a place of injection, of measurement or of a cut in this way, and a wire can be cut at some of its
consumers only: the loop to one consumer is cut at an inserted block.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...blocks.core import (
    Array,
    Block,
    Input,
    OptionError,
    Output,
    UnknownNameError,
    WiringError,
    elements,
    near,
)
from ..flat import FlatDiagram, WiredDiagram
from ..results import OperatingPoint, layout_of
from ..wiring import Structure, Wire, join
from .kinks import read_log
from .operating_points import PointLike, copy_point
from .taps import find_signal, wire_entries

Port = tuple[str, str]
STEP = 1e-3
"""Communication step in s with which signals of a diagram without a clock are looked up."""


class Passage(Block):
    """Passes a signal on."""

    u = Input(shape=None, description="signal")
    y = Output(like="u", description="the same signal")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the signal."""
        return u.u


def split_inputs(
    diagram: WiredDiagram, point: OperatingPoint, names: Iterable[str]
) -> tuple[WiredDiagram, OperatingPoint, Mapping[str, str]]:
    """Return the diagram with a block ahead of every input among the names, its operating point, and the blocks' ports.

    Names of wires and outputs are left out: an input has what no signal is called. An injection at a block's port
    reaches that input alone.
    """
    found: dict[str, str] = {}
    for name in dict.fromkeys(names):
        flat = diagram.flatten_like(point)
        try:
            find_signal(flat, name)
        except UnknownNameError as error:
            ports = _find_inputs(diagram, name)
            if error.candidates or len(ports) != 1:
                raise
            (port,) = ports
        else:
            continue
        wire = diagram.structure.wires[port]
        source, part = (wire.block, wire.port), wire_entries(flat, wire)
        diagram, point, found[name] = insert_ahead(diagram, flat, point, [port], source, part)
    return diagram, point, found


def name_inputs(labels: Iterable[str], ports: Mapping[str, str]) -> tuple[str, ...]:
    """Return labels of signals with the names of inputs in place of the inserted blocks' ports."""
    names = {port: name for name, port in ports.items()}
    parts = [label.partition("[") for label in labels]
    return tuple(names.get(base, base) + bracket + entry for base, bracket, entry in parts)


def _find_inputs(diagram: WiredDiagram, name: object) -> list[Port]:
    known = {join(*port): port for port in diagram.structure.wires}
    return [port for full, port in known.items() if full == name or full.endswith(f".{name}")]


def insert_ahead(
    diagram: WiredDiagram,
    flat: FlatDiagram,
    point: OperatingPoint,
    inputs: Sequence[Port],
    source: Port,
    entries: Sequence[int],
) -> tuple[WiredDiagram, OperatingPoint, str]:
    """Return the diagram with a block ahead of inputs of one source, its operating point, and the block's port.

    The inputs are in one subsystem; ``entries`` are those of the source that are wired to them.
    """
    table = diagram.structure.copy()
    path = _insert(table, inputs)
    split = diagram.with_structure(table)
    value = read_log(flat, point)[flat.log.slices[join(*source)]][list(entries)]
    return split, _carry_point(flat, split.flatten_like(point), point, path, value), f"{path}.y"


def _insert(table: Structure, inputs: Sequence[Port]) -> str:
    """Insert a block ahead of inputs of one source, all in one subsystem, and return its path."""
    subsystem = table.subsystem_of[inputs[0][0]]
    path = join(subsystem, "_".join(["to", *(f"{b.rpartition('.')[2]}_{p}" for b, p in inputs)]).replace(".", "_"))
    while path in table.blocks:
        path += "_"
    table.blocks[path] = Passage(name=path.rpartition(".")[2])
    table.subsystem_of[path] = subsystem
    table.wires[path, "u"] = table.wires[inputs[0]]
    for each in inputs:
        table.wires[each] = Wire(path, "y")
        table.handed.pop(each, None)
    return path


def name_wire_to(diagram: WiredDiagram, name: str, inputs: Sequence[Port]) -> WiredDiagram:
    """Return the diagram with a block ahead of some consumers of a wire; the wire between them has a name."""
    table = diagram.structure.copy()
    _check_one_subsystem(diagram, inputs)
    table.names[name] = Wire(_insert(table, inputs), "y")
    return diagram.with_structure(table)


def with_passed_values(diagram: WiredDiagram, point: OperatingPoint) -> OperatingPoint:
    """Return an operating point with the values of inserted blocks, where it is that of a diagram without them."""
    table, values = diagram.structure, dict(point.values)
    for path, block in table.blocks.items():
        if isinstance(block, Passage) and f"{path}.y" not in values:
            source = table.wires[path, "u"]
            passed = np.asarray(values[join(source.block, source.port)])
            values[f"{path}.y"] = passed if source.index is None else passed[source.index]
    return replace(point, values=values)


def _carry_point(
    flat: FlatDiagram, split: FlatDiagram, point: OperatingPoint, path: str, value: np.ndarray
) -> OperatingPoint:
    """Return the operating point of the diagram with the inserted block, which passes on ``value``."""
    known = dict(zip(flat.labels, point.x, strict=True))
    labels = elements(f"{path}.y", split.checked.shapes[path, "y"])
    own = {f"{kind}({label})": v for kind in ("held", "loop") for label, v in zip(labels, value, strict=True)}
    missing = [label for label in split.labels if label not in known and label not in own]
    if missing or len(known) + sum(label in own for label in split.labels) != split.width:
        raise OptionError(
            f"found other signals in the state where the wire is split ({', '.join(missing) or 'fewer'}), as of a "
            "solved algebraic loop; expected those of the operating point. Cut the whole wire.",
            block=path,
            port="to",
        )
    x = np.array([known[label] if label in known else own[label] for label in split.labels])
    return replace(point, x=x, layout=layout_of(split))


# --- consumers of a cut wire ------------------------------------------------------------------------------------------


def split_consumers(
    diagram: WiredDiagram, point: OperatingPoint, wires: Sequence[str], to: Iterable[str]
) -> tuple[WiredDiagram, OperatingPoint, str]:
    """Return the diagram with a block ahead of some consumers of a wire, its operating point, and the block's port."""
    if len(wires) != 1:
        raise OptionError(
            f"found {len(wires)} wires with to=…; expected one. Name the wire of these inputs.",
            block=diagram.name,
            port="to",
        )
    flat = diagram.flatten_like(point)
    signal = find_signal(flat, wires[0])
    inputs = find_inputs(diagram, flat, wires[0], to)
    _check_one_subsystem(diagram, inputs)
    return insert_ahead(diagram, flat, point, inputs, signal.port, signal.entries)


def _check_one_subsystem(diagram: WiredDiagram, inputs: Sequence[Port]) -> None:
    subsystems = {diagram.structure.subsystem_of[block] for block, _ in inputs}
    if len(subsystems) != 1:
        shown = ", ".join(repr(s or diagram.name) for s in sorted(subsystems))
        raise WiringError(
            f"found consumers in several subsystems, {shown}; expected one. Cut the wire to each of them alone.",
            block=inputs[0][0],
            port=inputs[0][1],
        )


def find_inputs(diagram: WiredDiagram, flat: FlatDiagram, wire: str, to: Iterable[str]) -> list[Port]:
    """Return the inputs of some names, which a wire feeds."""
    signal, table = find_signal(flat, wire), diagram.structure
    fed = [port for port, source in table.wires.items() if (source.block, source.port) == signal.port]
    inputs = [_find_input(diagram, name, fed) for name in to]
    for block, port in inputs:
        source = table.wires[block, port]
        if (source.block, source.port) != signal.port or wire_entries(flat, source) != signal.entries:
            fed_by_it = ", ".join(join(*c) for c in consumers_of(table.wires, signal.port)) or "it has none"
            raise WiringError(
                f"found {source} wired to it; expected {wire!r}. Name the wire that feeds this input, or one of "
                f"its consumers: {fed_by_it}.",
                block=block,
                port=port,
            )
    return inputs


def _find_input(diagram: WiredDiagram, name: str, fed: Sequence[Port]) -> Port:
    """Return the input of a name; of a block's name the only one that a wire feeds, or the only one that it has."""
    known = {join(*port): port for port in diagram.structure.wires}
    found = [name] if name in known else [n for n in known if n.endswith("." + name)]
    if not found:
        own = [port for port in known.values() if port[0] == name or port[0].endswith("." + name)]
        found = [join(*port) for port in own if port in fed] or [join(*port) for port in own]
    if len(found) != 1:
        several = f"several inputs end with {name!r}: {', '.join(found)}" if found else f"there is no input {name!r}"
        raise UnknownNameError(f"{several}. {near(name, known)}", block=diagram.name, port="to")
    return known[found[0]]


def consumers_of(wires: dict[Port, Wire], port: Port) -> list[Port]:
    """Return the inputs that a port feeds, by path."""
    return sorted(to for to, wire in wires.items() if (wire.block, wire.port) == port)


# --- wires that are cut by a name ------------------------------------------------------------------------------------


def name_of_cut(wire: str, inputs: Sequence[tuple[str, str]]) -> str:
    """Return the name of a wire ahead of some of its consumers: "u → plant.u"."""
    return f"{wire} → {', '.join(join(*to) for to in inputs)}" if inputs else wire


def cut_to(diagram: WiredDiagram, wire: str, to: str | Iterable[str]) -> tuple[WiredDiagram, str]:
    """Return the diagram in which a wire has a name ahead of some of its consumers, and that name."""
    flat = diagram.flatten(None if diagram.has_clock else STEP)
    inputs = find_inputs(diagram, flat, wire, [to] if isinstance(to, str) else to)
    name = name_of_cut(wire, inputs)
    return name_wire_to(diagram, name, inputs), name


def carry_point(diagram: WiredDiagram, point: PointLike, cut: WiredDiagram) -> PointLike:
    """Return an operating point of a diagram as one of the diagram in which wires are cut; other points as they are."""
    if not isinstance(point, OperatingPoint) or cut is diagram:
        return point
    return with_passed_values(cut, copy_point(diagram, with_passed_values(diagram, point), cut))
