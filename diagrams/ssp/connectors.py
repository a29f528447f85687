"""Connectors, connections and signal dictionaries, read from the XML of an SSP."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from .elements import INTEGERS, REALS, Connection, Connector, Transformation
from .xml_file import XmlFile, flag

_KINDS = ("input", "output", "inout", "parameter", "calculatedParameter", "structuralParameter", "constant", "local")
TYPES = {*REALS, *INTEGERS, "Boolean", "String", "Enumeration", "Binary"}
"""Elements that are the type of a connector or a parameter."""
_MAPPED = {"BooleanMappingTransformation": "boolean", "IntegerMappingTransformation": "integer"}
_MAPPED["EnumerationMappingTransformation"] = "enumeration"


def read_connector(file: XmlFile, element: Any, at: str) -> Connector:
    """Return a connector, or an entry of a signal dictionary."""
    name = file.name_of(element, at)
    where = ".".join(filter(None, (at, name)))
    kind = element.get("kind", "unspecified")
    if kind not in (*_KINDS, "unspecified", "acausal"):
        raise file.error(f"found the kind {kind!r}; expected one of {', '.join(_KINDS)}. Export it again.", where)
    type_, unit, items = "", None, dict[str, int]()
    for child in file.children(element):
        tag = file.expect(child, *TYPES, "Dimension", at=where)
        if tag == "Dimension":
            continue
        type_, unit = tag, file.find_unit(child.get("unit"))
        if tag == "Enumeration":
            items = file.enumerations.get(child.get("name", ""), {})
    return Connector(name, "unspecified" if kind == "acausal" else kind, type_, unit, file.shape(element, where), items)


def read_connectors(file: XmlFile, element: Any, at: str) -> dict[str, Connector]:
    """Return the connectors of an element by name."""
    found: dict[str, Connector] = {}
    for child in file.members("Connectors", element, "Connector", at=at):
        made = read_connector(file, child, at)
        if made.name in found:
            raise file.error(f"found two connectors {made.name!r}; expected one. Rename one.", at)
        found[made.name] = made
    return found


def read_transformation(file: XmlFile, element: Any, at: str) -> Transformation | None:
    """Return the transformation of a connection or of a mapping entry, if there is one."""
    for child in file.children(element):
        tag = file.expect(child, "LinearTransformation", *_MAPPED, at=at)
        if tag == "LinearTransformation":
            return Transformation(file.number(child, "factor", 1.0, at), file.number(child, "offset", 0.0, at))
        table = [(str(entry.get("source")), str(entry.get("target"))) for entry in file.children(child)]
        if len({source for source, _ in table}) < len(table):
            raise file.error(f"found two entries of one source in {tag}; expected one. Leave one out.", at)
        return Transformation(kind=_MAPPED[tag], table=tuple(table))
    return None


def read_connection(file: XmlFile, element: Any, at: str) -> Connection:
    """Return a connection."""
    for side in ("start", "end"):
        if not element.get(f"{side}Connector"):
            raise file.error(f"found a connection without {side}Connector; expected one. Export it again.", at)
        if element.get(f"{side}Indices") is not None:
            raise file.error(
                f"found {side}Indices={element.get(f'{side}Indices')!r} at a connection, which is not supported "
                "here; expected connections of whole connectors. Connect the array, or export scalars.",
                at,
            )
    start, end = ((element.get(f"{side}Element") or "", element.get(f"{side}Connector")) for side in ("start", "end"))
    return Connection(start, end, read_transformation(file, element, at), flag(element, "suppressUnitConversion"))


def read_dictionary(file: XmlFile, at: str) -> dict[str, Connector]:
    """Return the entries of a signal dictionary by name."""
    found: dict[str, Connector] = {}
    for element in file.children(file.root):
        if file.expect(element, "DictionaryEntry", "Enumerations", "Units", at=at) == "DictionaryEntry":
            entry = read_connector(file, element, at)
            found[entry.name] = replace(entry, kind="inout")
    return found
