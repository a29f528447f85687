"""Flow of values in a system structure: the connector that drives each connector, through the borders of systems."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from ...blocks.core import DoubleDriveError, SspFileError, near
from .elements import INPUTS, OUTPUTS, Component, Connection, Connector, DictionaryReference, Element, Names, System
from .parts import FmuPart


class ConnectorKey(NamedTuple):
    """Connector of an element by its names from the root system down, or entry of a signal dictionary."""

    element: Names
    connector: str
    is_entry: bool = False
    """Whether it is an entry; ``element`` then has the names of the system that defines the dictionary, and its name.
    """

    def __str__(self) -> str:
        return ".".join((*self.element, self.connector))


class Hop(NamedTuple):
    """Connection on the way of a value."""

    start: ConnectorKey
    connection: Connection
    end: ConnectorKey
    system: Names
    """The system that has the connection."""


@dataclass
class Dataflow:
    """Hop that ends at each connector, and what each connector is.

    ``notes``: remarks on connectors that no variable has, and that nothing is connected to.
    """

    root: System
    parts: Mapping[Names, FmuPart]
    notes: list[str]
    hops: dict[ConnectorKey, Hop] = field(default_factory=dict)
    connectors: dict[ConnectorKey, Connector] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._elements = dict(self.root.walk())
        for names, element in self._elements.items():
            for name, connector in element.connectors.items():
                if isinstance(element, Component):
                    part = self.parts[names]
                    if not part.has(name):
                        self.notes.append(f"the FMU of {part.path} has no variable {name!r}, which its connector names")
                        continue
                    found = part.connector(name)
                    self.connectors[ConnectorKey(names, found.name)] = found
                elif isinstance(element, System):
                    self.connectors[ConnectorKey(names, name)] = connector
            if isinstance(element, System):
                for dictionary, entries in element.dictionaries.items():
                    for name, entry in entries.items():
                        self.connectors[ConnectorKey((*names, dictionary), name, True)] = entry
        for names, element in self._elements.items():
            if isinstance(element, System):
                for connection in element.connections:
                    self._add(names, element, connection)

    def _add(self, names: Names, system: System, connection: Connection) -> None:
        """Add a connection in the direction in which its value flows (SSP 2.0, 5.4.2, Allowed Connections)."""
        start, start_kind, start_is_source, start_is_sink = self._find_end(names, system, connection, connection.start)
        end, end_kind, end_is_source, end_is_sink = self._find_end(names, system, connection, connection.end)
        if start_is_source and end_is_sink:
            hop = Hop(start, connection, end, names)
        elif end_is_source and start_is_sink:
            hop = Hop(end, connection, start, names)
        else:
            raise SspFileError(
                f"found a connection {connection} of kinds {start_kind} and {end_kind}; expected one from which a "
                "value comes to one that takes it. Correct a kind, or leave the connection out.",
                block=".".join(names) or None,
            )
        known = self.hops.get(hop.end)
        if known is None:
            self.hops[hop.end] = hop
        elif (known.start, known.connection) != (hop.start, hop.connection):
            raise DoubleDriveError(
                f"found two connections that drive it, {known.connection} and {connection}; expected one. Leave one "
                "out.",
                block=".".join(hop.end.element) or self.root.name,
                port=hop.end.connector,
            )

    def _find_end(
        self, names: Names, system: System, connection: Connection, end: tuple[str, str]
    ) -> tuple[ConnectorKey, str, bool, bool]:
        """Return an end of a connection, its kind, and whether a value comes from it or goes to it."""
        name, port = end
        where = ".".join(names) or None
        if not name:
            if port not in system.connectors:
                raise SspFileError(
                    f"found the connection {connection}; the system has no connector {port!r}; expected one of its "
                    f"own. {near(port, system.connectors)}",
                    block=where,
                )
            kind = system.connectors[port].kind
            open_ended = kind in ("inout", "unspecified")
            return (
                ConnectorKey(names, port),
                f"system {kind}",
                open_ended or kind in INPUTS,
                open_ended or kind in OUTPUTS,
            )
        element = system.elements.get(name)
        if element is None:
            raise SspFileError(
                f"found the connection {connection}; there is no element {name!r}; expected one of the system. "
                f"{near(name, system.elements)}",
                block=where,
            )
        node, connector = self._find_connector((*names, name), element, port, connection)
        kind = connector.kind
        open_ended = kind in ("inout", "unspecified")
        if isinstance(element, DictionaryReference):
            return node, f"dictionary {kind}", open_ended or kind in OUTPUTS, open_ended or kind in INPUTS
        return node, kind, open_ended or kind in OUTPUTS, open_ended or kind in INPUTS

    def _find_connector(
        self, names: Names, element: Element, port: str, connection: Connection
    ) -> tuple[ConnectorKey, Connector]:
        if isinstance(element, Component):
            if port in element.connectors:
                found = self.parts[names].connector(port)
                return ConnectorKey(names, found.name), found
        elif port in element.connectors:
            if isinstance(element, DictionaryReference):
                return self._find_entry(names, element, port), element.connectors[port]
            return ConnectorKey(names, port), element.connectors[port]
        raise SspFileError(
            f"found the connection {connection}; the element has no connector {port!r}; expected one of its own. "
            f"{near(port, element.connectors)}",
            block=".".join(names),
        )

    def _find_entry(self, names: Names, reference: DictionaryReference, port: str) -> ConnectorKey:
        """Return the entry of a dictionary, which is looked up in the systems around its reference."""
        for n in range(len(names) - 1, -1, -1):
            system = self._elements[names[:n]]
            assert isinstance(system, System)
            if reference.dictionary in system.dictionaries:
                entries = system.dictionaries[reference.dictionary]
                if port not in entries:
                    raise SspFileError(
                        f"found the connector {port!r}; the signal dictionary {reference.dictionary!r} has no entry of "
                        f"that name; expected one of its own. {near(port, entries)}",
                        block=".".join(names),
                    )
                return ConnectorKey((*names[:n], reference.dictionary), port, True)
        raise SspFileError(
            f"found a reference to the signal dictionary {reference.dictionary!r}, which no system around it has; "
            "expected its definition there. Add it.",
            block=".".join(names),
        )

    def trace(self, node: ConnectorKey) -> tuple[ConnectorKey, list[Hop]]:
        """Return where the value of a connector comes from, and the connections on the way, from there on."""
        way: list[Hop] = []
        seen = {node}
        while node in self.hops:
            hop = self.hops[node]
            way.append(hop)
            node = hop.start
            if node in seen:
                raise SspFileError(
                    f"found connections in a circle through {', '.join(str(h.end) for h in way)}, none of which comes "
                    "from an element; expected a source. Leave one out.",
                    block=".".join(node.element) or None,
                )
            seen.add(node)
        return node, way[::-1]
