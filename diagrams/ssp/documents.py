"""XML of an SSP that is written: description, parameter sets and signal dictionary, by the schemas of the standard.

For tools that draw it, its elements have the places that they have in a drawing of the diagram.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...blocks.core import BASE_UNITS, Unit, parse_unit
from ...blocks.version import __version__
from ..drawing import Net, Node, Pin, arrange
from .terms import Term

SPACES = {
    prefix: f"http://ssp-standard.org/SSP1/SystemStructure{end}"
    for prefix, end in (
        ("ssd", "Description"),
        ("ssc", "Common"),
        ("ssv", "ParameterValues"),
        ("ssb", "SignalDictionary"),
    )
}
SPACES["osp"] = "http://opensimulationplatform.com/SSP/OSPAnnotations"
_TYPES = {"Float64": "Real", "Float32": "Real", "Int32": "Integer", "Boolean": "Boolean", "String": "String"}
_TYPES |= {"Enumeration": "Enumeration", "Binary": "Binary"}
_FLOATS = ("Float64", "Float32")
_SMALL = {f"{sign}Int{bits}": "Integer" for sign, bits in (("", 8), ("U", 8), ("", 16), ("U", 16))}
_SCALE = 0.25
"""mm of the SSP's canvas for each pixel of a drawing."""
_WIDTH, _ROW, _LEAST, _MARGIN = 130.0, 16.0, 44.0, 40.0
"""Pixels: width of an element, height for each connector, least height, and around all elements."""


@dataclass
class WrittenConnector:
    """Connector of an element that is written."""

    name: str
    kind: str
    type: str = "Float64"
    """Type as FMI 3.0 names it."""
    unit: str | None = None
    shape: tuple[int, ...] = ()
    items: Mapping[str, int] = field(default_factory=dict)
    place: tuple[float, float] | None = None
    """Place on its element: from the left and from below, 0 to 1."""


@dataclass
class WrittenConnection:
    """Connection that is written; an end is an element's name, "" for the system, and a connector."""

    start: tuple[str, str]
    end: tuple[str, str]
    term: Term = field(default_factory=Term)
    suppress_units: bool = False


@dataclass
class WrittenElement:
    """Component or system that is written."""

    name: str
    source: str = ""
    implementation: str = ""
    binding: str = ""
    """File of its parameter set; empty for none."""
    connectors: dict[str, WrittenConnector] = field(default_factory=dict)
    elements: dict[str, WrittenElement] = field(default_factory=dict)
    connections: list[WrittenConnection] = field(default_factory=list)
    box: tuple[float, float, float, float] | None = None
    """Left, lower, right and upper edge in mm, in the system around it."""
    canvas: tuple[float, float] | None = None
    """Width and height in mm of the inside of a system."""
    dictionary: str = ""
    """File of a signal dictionary that a system defines."""


@dataclass(frozen=True)
class WrittenValue:
    """Value of a parameter that is written."""

    name: str
    type: str
    value: Any
    unit: str | None = None
    items: Mapping[str, int] = field(default_factory=dict)


class XmlDocument:
    """One XML file: its units and enumerations are collected while it is made."""

    def __init__(self, version: str):
        from lxml import etree

        self.etree, self.version = etree, version
        self.units: dict[str, Unit] = {}
        self.enumerations: dict[str, Mapping[str, int]] = {}

    # --- parts -------------------------------------------------------------------------------------------------------

    def add(self, parent: Any, tag: str, **attributes: object) -> Any:
        """Add an element, ``prefix:Name``; attributes that are None are left out."""
        prefix, _, name = tag.partition(":")
        shown = {key: str(value) for key, value in attributes.items() if value is not None}
        return self.etree.SubElement(parent, f"{{{SPACES[prefix]}}}{name}", shown)

    def root(self, tag: str, *prefixes: str, **attributes: object) -> Any:
        """Return the root element of a file."""
        prefix, _, name = tag.partition(":")
        shown = {key: str(value) for key, value in attributes.items() if value is not None}
        spaces = {p: SPACES[p] for p in dict.fromkeys((prefix, "ssc", *prefixes))}
        made = self.etree.Element(f"{{{SPACES[prefix]}}}{name}", shown, nsmap=spaces)
        made.set("version", self.version)
        made.set("generationTool", f"Loopwright {__version__}")
        return made

    def text(self, root: Any) -> bytes:
        """Return the file."""
        found: bytes = self.etree.tostring(root, xml_declaration=True, encoding="UTF-8", pretty_print=True)
        return found

    def unit(self, name: str | None) -> str | None:
        """Return a unit's name, and note its definition; a second unit of one name gets another."""
        if name is None:
            return None
        unit, label, count = parse_unit(name), str(name), 2
        known = self.units.get(label)
        while known is not None and (known.exponents, known.factor, known.offset) != (
            unit.exponents,
            unit.factor,
            unit.offset,
        ):
            label, count = f"{name}_{count}", count + 1
            known = self.units.get(label)
        self.units[label] = unit
        return label

    def enumeration(self, items: Mapping[str, int]) -> str:
        """Return the name of an enumeration, and note its items."""
        for name, known in self.enumerations.items():
            if dict(known) == dict(items):
                return name
        name = f"enumeration_{len(self.enumerations) + 1}"
        self.enumerations[name] = items
        return name

    def close(self, root: Any, prefix: str) -> None:
        """Add the enumerations and units that the file uses."""
        if self.enumerations:
            group = self.add(root, f"{prefix}:Enumerations")
            for name, items in self.enumerations.items():
                made = self.add(group, "ssc:Enumeration", name=name)
                for item, value in items.items():
                    self.add(made, "ssc:Item", name=item, value=value)
        if self.units:
            group = self.add(root, f"{prefix}:Units")
            for name, unit in self.units.items():
                powers = {b: n for b, n in zip(BASE_UNITS, unit.exponents, strict=True) if n}
                numbers = {"factor": unit.factor, "offset": unit.offset}
                given = {key: repr(value) for key, value in numbers.items() if value != (key == "factor")}
                self.add(self.add(group, "ssc:Unit", name=name), "ssc:BaseUnit", **powers, **given)

    def type(self, parent: Any, connector: WrittenConnector) -> None:
        """Add the type of a connector or of an entry of a dictionary."""
        if connector.type == "Enumeration":
            self.add(parent, "ssc:Enumeration", name=self.enumeration(connector.items))
        else:
            unit = self.unit(connector.unit) if connector.type in _FLOATS else None
            self.add(parent, f"ssc:{type_name(connector.type)}", unit=unit)
        for size in connector.shape:
            self.add(parent, "ssc:Dimension", size=size)


def type_name(name: str) -> str:
    """Return SSP's name of a type, by FMI 3.0's; types that only SSP 2.0 has keep theirs."""
    return _TYPES.get(name) or _SMALL.get(name) or name


def needs_version_2(connectors: Iterable[WrittenConnector], values: Iterable[WrittenValue]) -> bool:
    """Whether arrays or large integers ask for SSP 2.0."""
    types = {*_TYPES, *_SMALL}
    return any(c.shape or c.type not in types for c in connectors) or any(
        np.ndim(v.value) or v.type not in types for v in values
    )


def write_values(version: str, name: str, values: Sequence[WrittenValue]) -> bytes:
    """Return a parameter set."""
    made = XmlDocument(version)
    root = made.root("ssv:ParameterSet", name=name)
    group = made.add(root, "ssv:Parameters")
    for value in values:
        element = made.add(group, "ssv:Parameter", name=value.name)
        unit = made.unit(value.unit) if value.type in _FLOATS else None
        made.add(element, f"ssv:{type_name(value.type)}", value=_text(value), unit=unit)
        for size in np.shape(value.value) if not isinstance(value.value, str | bytes) else ():
            made.add(element, "ssc:Dimension", size=size)
    made.close(root, "ssv")
    return made.text(root)


def _text(value: WrittenValue) -> str:
    if isinstance(value.value, str):
        return value.value
    if isinstance(value.value, bytes):
        return value.value.hex()
    return " ".join(_number(float(number), value) for number in np.ravel(value.value))


def _number(number: float, value: WrittenValue) -> str:
    if value.type == "Enumeration":
        return next((name for name, item in value.items.items() if item == number), str(int(number)))
    if value.type == "Boolean":
        return "true" if number else "false"
    return repr(number) if value.type in _FLOATS else str(int(number))


def write_dictionary(version: str, entries: Sequence[WrittenConnector]) -> bytes:
    """Return a signal dictionary."""
    made = XmlDocument(version)
    root = made.root("ssb:SignalDictionary")
    for entry in entries:
        made.type(made.add(root, "ssb:DictionaryEntry", name=entry.name), entry)
    made.close(root, "ssb")
    return made.text(root)


def write_description(version: str, name: str, system: WrittenElement, stop: float | None, step: float | None) -> bytes:
    """Return a system structure description."""
    made = XmlDocument(version)
    prefixes = ("ssv", "ssb") if step is None else ("ssv", "ssb", "osp")
    root = made.root("ssd:SystemStructureDescription", *prefixes, name=name)
    _add_system(made, root, system)
    made.close(root, "ssd")
    if stop is not None or step is not None:
        times = {} if stop is None else {"startTime": "0.0", "stopTime": repr(float(stop))}
        experiment = made.add(root, "ssd:DefaultExperiment", **times)
        if step is not None:
            group = made.add(experiment, "ssd:Annotations")
            note = made.add(group, "ssc:Annotation", type="com.opensimulationplatform")
            algorithm = made.add(note, "osp:Algorithm")  # its namespace is declared at the root: libcosim's parser asks
            made.add(algorithm, "osp:FixedStepAlgorithm", baseStepSize=repr(float(step)))
    return made.text(root)


def _add_connectors(made: XmlDocument, parent: Any, element: WrittenElement) -> None:
    if element.connectors:
        group = made.add(parent, "ssd:Connectors")
        for connector in element.connectors.values():
            added = made.add(group, "ssd:Connector", name=connector.name, kind=connector.kind)
            made.type(added, connector)
            if connector.place is not None:
                x, y = connector.place
                made.add(added, "ssd:ConnectorGeometry", x=f"{x:.4g}", y=f"{y:.4g}")
    if element.box is not None:
        edges = dict(zip(("x1", "y1", "x2", "y2"), (f"{edge:.5g}" for edge in element.box), strict=True))
        made.add(parent, "ssd:ElementGeometry", **edges)
    if element.binding:
        group = made.add(parent, "ssd:ParameterBindings")
        made.add(group, "ssd:ParameterBinding", source=element.binding)


def _add_system(made: XmlDocument, parent: Any, system: WrittenElement) -> None:
    root = made.add(parent, "ssd:System", name=system.name)
    _add_connectors(made, root, system)
    group = made.add(root, "ssd:Elements") if system.elements else None
    for element in system.elements.values():
        if element.source:
            implementation = element.implementation or None
            added = made.add(
                group,
                "ssd:Component",
                name=element.name,
                type="application/x-fmu-sharedlibrary",
                source=element.source,
                implementation=implementation,
            )
            _add_connectors(made, added, element)
        else:
            _add_system(made, group, element)
    group = made.add(root, "ssd:Connections") if system.connections else None
    for connection in system.connections:
        _add_connection(made, group, connection)
    if system.dictionary:
        group = made.add(root, "ssd:SignalDictionaries")
        made.add(group, "ssd:SignalDictionary", name="signals", source=system.dictionary)
    if system.canvas is not None:
        width, height = (f"{size:.5g}" for size in system.canvas)
        made.add(root, "ssd:SystemGeometry", x1="0", y1="0", x2=width, y2=height)


def _add_connection(made: XmlDocument, group: Any, connection: WrittenConnection) -> None:
    (start, a), (end, b) = connection.start, connection.end
    added = made.add(
        group,
        "ssd:Connection",
        startElement=start or None,
        startConnector=a,
        endElement=end or None,
        endConnector=b,
        suppressUnitConversion="true" if connection.suppress_units else None,
    )
    term = connection.term
    if term.table:
        table = made.add(added, "ssc:IntegerMappingTransformation")
        for source, target in term.table:
            made.add(table, "ssc:MapEntry", source=int(source), target=int(target))
    elif not term.is_plain:
        made.add(added, "ssc:LinearTransformation", factor=repr(term.factor), offset=repr(term.offset))


def lay_out(system: WrittenElement) -> None:
    """Place the elements of a system and of those in it, and their connectors: inputs on the left, outputs right."""
    nodes: list[Node] = []
    for element in system.elements.values():
        if element.elements:
            lay_out(element)
        ins, outs = (
            [n for n, c in element.connectors.items() if (c.kind == "input") == side] for side in (True, False)
        )
        height = max(_LEAST, _ROW * (max(len(ins), len(outs)) + 1))
        on_left, on_right = (
            {Pin(n): height * (i + 1) / (len(names) + 1) for i, n in enumerate(names)} for names in (ins, outs)
        )
        nodes.append(Node(element.name, _WIDTH, height, on_left, on_right))
        _place_connectors(element)
    nets: dict[tuple[str, str], Net] = {}
    for connection in system.connections:
        (start, a), (end, b) = connection.start, connection.end
        if start and end:
            net = nets.setdefault((start, a), Net(f"{start}.{a}", (start, Pin(a)), []))
            net.sinks.append((end, Pin(b)))
    width, height = arrange(nodes, list(nets.values()))
    width, height = width + 2 * _MARGIN, height + 2 * _MARGIN
    system.canvas = _SCALE * width, _SCALE * height
    for node in nodes:
        left, low = node.x + _MARGIN, height - (node.y + _MARGIN + node.height)
        edges = left, low, left + node.width, low + node.height
        x1, y1, x2, y2 = (_SCALE * edge for edge in edges)
        system.elements[node.key].box = x1, y1, x2, y2
    _place_connectors(system)


def _place_connectors(element: WrittenElement) -> None:
    for is_input in (True, False):
        side = [c for c in element.connectors.values() if (c.kind == "input") == is_input]
        for i, connector in enumerate(side):
            connector.place = (0.0 if is_input else 1.0), 1.0 - (i + 1) / (len(side) + 1)
