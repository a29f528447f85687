"""The structure of a diagram, assembled from a system structure: FMUs, the blocks of its transformations, and wires."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from ...blocks.core import (
    Block,
    Constant,
    Gain,
    LoopwrightError,
    OptionError,
    SspFileError,
    Stack,
    Sum,
    convert_unit,
    near,
    same_dimension,
    same_unit,
)
from ...blocks.library import UnitConversion
from ...fmus import ArchiveLimits, Fmu
from ..wiring import Structure, SubsystemSettings, Wire, join
from .dataflow import ConnectorKey, Dataflow, Hop
from .elements import OUTPUTS, Component, Names, System
from .parameter_sets import Given, apply_bindings, value_table
from .parts import FmuPart
from .value_table import ValueTable

Operation = tuple[Any, ...]
"""Step of a value on its way: ``("unit", from, to)``, ``("linear", factor, offset)`` or ``("table", pairs)``."""


class Feed(NamedTuple):
    """What a connector gets: the connector where it comes from, and the steps on the way."""

    origin: ConnectorKey
    operations: tuple[Operation, ...]


@dataclass
class Assembly:
    """A system structure on its way to a diagram's structure.

    ``inputs``: values of inputs of the root system, in place of those of the parameter sets.
    ``notes``: takes remarks on what has no effect.
    """

    root: System
    limits: ArchiveLimits
    inputs: Mapping[str, Any]
    notes: list[str]
    table: Structure = field(default_factory=Structure)

    def __post_init__(self) -> None:
        walked = dict(self.root.walk())
        self.systems = {names: e for names, e in walked.items() if isinstance(e, System)}
        self.parts = {names: FmuPart(names, e, self.limits) for names, e in walked.items() if isinstance(e, Component)}
        self.paths = _make_paths(self.root)
        self._taken = set(self.paths.values())
        self._sources: dict[ConnectorKey, Wire] = {}
        self._made: dict[tuple[Any, ...], Wire] = {}

    def structure(self) -> Structure:
        """Return the structure.

        Raises `SspFileError`: for connections and parameters that don't fit the FMUs.
        Raises `DoubleDriveError`: for a connector at which two connections end.
        """
        self.flow = Dataflow(self.root, self.parts, self.notes)
        self.given, notes = apply_bindings(self.root, self.parts)
        self.notes += notes
        self._check_inputs()
        self._place_systems()
        feeds = {node: self._feed(node) for node in self.flow.hops if node.element in self.parts}
        for node, given in self.given.items():
            if node.element in self.parts and node not in feeds:
                self._set_start(node, given)
        wired = self._split_feeds(feeds)
        self._make_inputs(wired)
        self._make_parts()
        self._wire_parts(wired)
        self._name_outputs()
        return self.table

    def _check_inputs(self) -> None:
        known = [n for n, c in self.root.connectors.items() if c.kind not in OUTPUTS]
        for name in self.inputs:
            if name not in known:
                raise OptionError(
                    f"the root system has no input {name!r}. {near(name, known)}", port="inputs", block=self.root.name
                )

    # --- systems and blocks ------------------------------------------------------------------------------------------

    def _place_systems(self) -> None:
        for names, system in self.systems.items():
            ports = {
                kind: [_identifier(n) for n, c in system.connectors.items() if (c.kind in OUTPUTS) == kind]
                for kind in (False, True)
            }
            path = self.paths[names]
            inside = any(other[: len(names)] == names for other in self.parts)
            if not names:
                self.table.subsystems[""] = SubsystemSettings("", None, "exact")
            elif inside:
                self.table.subsystems[path] = SubsystemSettings(
                    path, None, None, tuple(ports[False]), tuple(ports[True])
                )

    def _add_block(
        self, block: type[Block], name: str, subsystem: str, *, is_named: bool = False, **parameters: Any
    ) -> str:
        """Add a block and return its path; a name that is taken gets a number.

        Named are blocks that stand for something in the file; those of its transformations have a path alone.
        """
        path, count = join(subsystem, name), 2
        while path in self._taken:
            path, count = join(subsystem, f"{name}_{count}"), count + 1
        self._taken.add(path)
        label = {"name": path.rpartition(".")[2]} if is_named else {}
        self.table.blocks[path] = block(**label, **parameters)
        self.table.subsystem_of[path] = subsystem
        return path

    # --- values ------------------------------------------------------------------------------------------------------

    def _unit(self, node: ConnectorKey) -> str | None:
        return self.flow.connectors[node].unit if node in self.flow.connectors else None

    def _feed(self, node: ConnectorKey) -> Feed:
        """Return what a connector gets: conversions of units come ahead of the transformation (SSP 2.0, 4.5.3.1)."""
        origin, way = self.flow.trace(node)
        unit, operations = self._unit(origin), list[Operation]()
        since = unit
        for hop in way:
            target = self._unit(hop.end)
            if hop.connection.suppress_units:
                self._convert(operations, since, unit, hop)
                if target is not None and unit is not None and not same_unit(unit, target):
                    operations.append(("linear", 1.0, 0.0))  # a gain, whose output has no declared unit
                since = unit = target or unit
            elif target is not None:
                since, unit = (target if since is None else since), target
            change = hop.connection.transformation
            if change is not None:
                self._convert(operations, since, unit, hop)
                since = unit
                operations.append(self._operation(change, hop))
        if way:
            self._convert(operations, since, unit, way[-1])
        return Feed(origin, tuple(operations))

    def _convert(self, operations: list[Operation], since: str | None, unit: str | None, hop: Hop) -> None:
        if since is None or unit is None or same_unit(since, unit):
            return
        if not same_dimension(since, unit):
            raise SspFileError(
                f"found a connection {hop.connection} from {since} to {unit}; expected units of one dimension. Correct "
                "the unit of a connector, or set suppressUnitConversion.",
                block=".".join(hop.system) or None,
            )
        operations.append(("unit", since, unit))

    def _operation(self, change: Any, hop: Hop) -> Operation:
        if change.kind == "linear":
            return "linear", change.factor, change.offset
        ends = [self.flow.connectors[node] for node in (hop.start, hop.end)]
        table = value_table(change, ends[0].items, ends[1].items, ".".join(hop.system) or self.root.name)
        return "table", tuple(sorted(table.items()))

    def _set_start(self, node: ConnectorKey, given: Given) -> None:
        """Set the start value of an FMU's variable."""
        part = self.parts[node.element]
        about = part.description
        items = about.find(node.connector).items if node.connector in about.names else {}
        unit = self.flow.connectors[node].unit if node in self.flow.connectors else None
        if unit is None and node.connector in about.names:
            unit = about.find(node.connector).unit
        part.start[node.connector] = given.number(unit, items)

    def _split_feeds(self, feeds: Mapping[ConnectorKey, Feed]) -> dict[ConnectorKey, Feed]:
        """Return the feeds that become wires; the values of others become start values of the FMUs."""
        wired: dict[ConnectorKey, Feed] = {}
        for node, feed in feeds.items():
            part, origin = self.parts[node.element], feed.origin
            if origin.element in self.parts:
                source = self.flow.connectors[origin]
                if self.flow.connectors[node].kind == "input":
                    wired[node] = feed
                elif source.kind == "constant":
                    start = self.parts[origin.element].start_of(origin.connector)
                    part.start[node.connector] = apply_operations(0.0 if start is None else start, feed.operations)
                else:
                    raise SspFileError(
                        f"found a connection of {origin}, which an FMU computes ({source.kind}), to a parameter; "
                        "expected a constant, or a parameter of a system. Give the parameter's value by a parameter "
                        "set.",
                        block=part.path,
                        port=node.connector,
                    )
            elif (
                not origin.element
                and not origin.is_entry
                and self.flow.connectors[node].kind == "input"
                and (self.flow.connectors[origin].kind not in ("parameter", "structuralParameter", "constant"))
            ):
                wired[node] = feed
            else:
                self._start_from(node, feed)
        return wired

    def _start_from(self, node: ConnectorKey, feed: Feed) -> None:
        """Set a start value from the connector of a system that nothing drives, if it has a value."""
        given = self.given.get(feed.origin)
        if given is not None:
            connector = self.flow.connectors[feed.origin]
            value = given.number(connector.unit, connector.items or self.flow.connectors[node].items)
            self.parts[node.element].start[node.connector] = apply_operations(value, feed.operations)
        elif node in self.given:
            self._set_start(node, self.given[node])

    def _make_inputs(self, wired: Mapping[ConnectorKey, Feed]) -> None:
        """Make a block of each input of the root system: a constant, which `Diagram.replace` takes another source for.

        Raises `SspFileError`: for an input without a value, whose connections end at inputs with different start
        values.
        """
        users: dict[ConnectorKey, list[tuple[ConnectorKey, Feed]]] = {}
        for node, feed in wired.items():
            if feed.origin.element not in self.parts:
                users.setdefault(feed.origin, []).append((node, feed))
        for origin, used in users.items():
            connector, given = self.flow.connectors[origin], self.given.get(origin)
            if origin.connector in self.inputs:
                value = self.inputs[origin.connector]
            elif given is not None:
                value = given.number(connector.unit, connector.items)
            else:
                value = self._common_start(origin, used)
            if isinstance(value, str | bytes):
                raise SspFileError(
                    f"found a text for the input {origin.connector!r}; expected a number, which alone a wire carries. "
                    "Give it to the component by a parameter set.",
                    block=self.root.name,
                )
            path = self._add_block(
                Constant,
                _identifier(origin.connector),
                "",
                is_named=True,
                value=np.asarray(value, dtype=float),
                unit=connector.unit,
            )
            self._sources[origin] = Wire(path, "y")

    def _common_start(self, origin: ConnectorKey, used: Sequence[tuple[ConnectorKey, Feed]]) -> Any:
        found: list[tuple[ConnectorKey, Any]] = []
        for node, feed in used:
            if node in self.given:
                self._set_start(node, self.given[node])
            start = self.parts[node.element].start_of(node.connector)
            self.parts[node.element].start.pop(node.connector, None)
            if start is not None:
                found.append((node, apply_operations(start, feed.operations, backwards=True)))
        if not found:
            return 0.0
        (first, value), *others = found
        for other, number in others:
            if not np.allclose(number, value, rtol=1e-12, atol=0.0):
                raise SspFileError(
                    f"found no value of the input {origin.connector!r}, which drives {first} (start value {value:g}) "
                    f"and {other} ({number:g}); expected one value. Give it: inputs={{{origin.connector!r}: …}}.",
                    block=self.root.name,
                    port=origin.connector,
                )
        return value

    # --- FMUs and wires ----------------------------------------------------------------------------------------------

    def _make_parts(self) -> None:
        for hop in self.flow.hops.values():
            if hop.start.element in self.parts and self.flow.connectors[hop.start].kind != "output":
                self.parts[hop.start.element].read.add(hop.start.connector)
        for names, part in self.parts.items():
            path = self.paths[names]
            fed = {node.connector for node in self.flow.hops if node.element == names}
            for scalars in part.members("input").values():
                for name in scalars:
                    if name not in part.start and name not in fed:
                        own = part.start_of(name)
                        shape = part.description.find(name).shape
                        part.start[name] = np.zeros(shape) if own is None else own
            try:
                self.table.blocks[path] = Fmu(
                    part.component.file,
                    name=path.rpartition(".")[2],
                    start=part.start,
                    ports=part.ports,
                    interface=part.interface,
                    limits=None if self.limits == ArchiveLimits() else self.limits,
                )
            except LoopwrightError as error:
                raise error.blame(".".join(names)) from None
            self.table.subsystem_of[path] = self.paths[names[:-1]]

    def _wire_parts(self, wired: Mapping[ConnectorKey, Feed]) -> None:
        for names, part in self.parts.items():
            for port, scalars in part.members("input").items():
                feeds = [wired.get(ConnectorKey(names, name)) for name in scalars]
                if not any(feeds):
                    continue
                subsystem, path = self.paths[names[:-1]], self.paths[names]
                wire = self._whole_wire(feeds, subsystem, path)
                if wire is None:
                    wire = self._stack(names, scalars, feeds, subsystem, path)
                self.table.wires[path, port] = wire

    def _source(self, origin: ConnectorKey) -> tuple[Wire, tuple[int, ...]]:
        """Return the wire of an origin, and the shape of the port that it comes from."""
        if origin.element in self.parts:
            port, index, shape = self.parts[origin.element].port(origin.connector)
            return Wire(self.paths[origin.element], port, index), shape
        return self._sources[origin], ()

    def _whole_wire(self, feeds: Sequence[Feed | None], subsystem: str, path: str) -> Wire | None:
        """Return the wire of a whole port, where its entries come from one port in order; None where they don't."""
        first = feeds[0]
        if first is None:
            return None
        if len(feeds) == 1:
            return self._operate(self._source(first.origin)[0], first.operations, subsystem, path)
        for i, feed in enumerate(feeds):
            if feed is None or feed.operations != first.operations or feed.origin.element not in self.parts:
                return None
            wire, shape = self._source(feed.origin)
            if shape != (len(feeds),) or wire.index != i or wire.block != self.paths[first.origin.element]:
                return None
            if wire.port != self._source(first.origin)[0].port:
                return None
        source = self._source(first.origin)[0]
        return self._operate(Wire(source.block, source.port), first.operations, subsystem, path)

    def _stack(
        self, names: Names, scalars: Sequence[str], feeds: Sequence[Feed | None], subsystem: str, path: str
    ) -> Wire:
        part, label = self.parts[names], path.rpartition(".")[2]
        stack = self._add_block(Stack, f"to_{label}", subsystem, count=len(feeds))
        for i, (name, feed) in enumerate(zip(scalars, feeds, strict=True), 1):
            if feed is None:
                value = part.start_of(name)
                held = self._add_block(
                    Constant, f"start_of_{label}", subsystem, value=np.array(0.0) if value is None else value
                )
                wire = Wire(held, "y")
                part.start.pop(name, None)
            else:
                wire = self._operate(self._source(feed.origin)[0], feed.operations, subsystem, path)
            self.table.wires[stack, f"u{i}"] = wire
        return Wire(stack, "y")

    def _operate(self, wire: Wire, operations: Sequence[Operation], subsystem: str, path: str) -> Wire:
        """Return the wire behind the blocks of some steps; consumers in one subsystem share them."""
        label = path.rpartition(".")[2]
        for operation in operations:
            key = (subsystem, wire, operation)
            if key not in self._made:
                self._made[key] = self._add_operation(wire, operation, subsystem, f"to_{label}")
            wire = self._made[key]
        return wire

    def _add_operation(self, wire: Wire, operation: Operation, subsystem: str, name: str) -> Wire:
        kind, *values = operation
        if kind == "unit":
            made = self._add_block(UnitConversion, name, subsystem, from_unit=values[0], to_unit=values[1])
            self.table.wires[made, "u"] = wire
            return Wire(made, "y")
        if kind == "table":
            made = self._add_block(ValueTable, name, subsystem, table=dict(values[0]))
            self.table.wires[made, "u"] = wire
            return Wire(made, "y")
        factor, offset = values
        made = self._add_block(Gain, name, subsystem, gain=factor)
        self.table.wires[made, "u"] = wire
        if not offset:
            return Wire(made, "y")
        held = self._add_block(Constant, f"{name}_offset", subsystem, value=offset)
        total = self._add_block(Sum, f"{name}_sum", subsystem, signs="++")
        self.table.wires[total, "u1"], self.table.wires[total, "u2"] = Wire(made, "y"), Wire(held, "y")
        return Wire(total, "y")

    def _name_outputs(self) -> None:
        """Name the wires of systems' outputs by their connectors, and note where their inputs come from."""
        for names, system in self.systems.items():
            for name, connector in system.connectors.items():
                node = ConnectorKey(names, name)
                if node not in self.flow.hops:
                    continue
                feed, path = self._feed(node), self.paths[names]
                if feed.origin.element not in self.parts and feed.origin not in self._sources:
                    continue
                if connector.kind not in OUTPUTS:
                    if path in self.table.subsystems and not feed.operations:
                        self.table.arguments[path, _identifier(name)] = self._source(feed.origin)[0]
                    continue
                wire = self._operate(self._source(feed.origin)[0], feed.operations, path, join(path, _identifier(name)))
                self.table.names[join(path, _identifier(name))] = wire
                if path in self.table.subsystems and names:
                    self.table.results[path, _identifier(name)] = wire


def apply_operations(value: Any, operations: Sequence[Operation], *, backwards: bool = False) -> Any:
    """Return a value behind some steps, or the one ahead of them."""
    for kind, *numbers in reversed(operations) if backwards else operations:
        if kind == "table":
            pairs = dict(numbers[0])
            pairs = {b: a for a, b in pairs.items()} if backwards else pairs
            value = pairs.get(float(value), value)
            continue
        factor, offset = convert_unit(*numbers) if kind == "unit" else numbers
        value = (value - offset) / factor if backwards else factor * value + offset
    return value


def _identifier(name: str) -> str:
    """Return a name as one that a block or a wire can have."""
    found = re.sub(r"\W", "_", name)
    return found if found.isidentifier() else f"_{found}"


def _make_paths(root: System) -> dict[Names, str]:
    """Return the path of each element's block or subsystem, by its names; names that are no identifiers get others."""
    paths: dict[Names, str] = {(): ""}
    taken: set[str] = set()
    for names, _ in sorted(root.walk(), key=lambda item: (len(item[0]), not all(n.isidentifier() for n in item[0]))):
        if not names:
            continue
        base, count = join(paths[names[:-1]], _identifier(names[-1])), 2
        path = base
        while path in taken:
            path, count = f"{base}_{count}", count + 1
        taken.add(path)
        paths[names] = path
    return paths
