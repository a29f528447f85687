"""Parameter bindings with their sets and mappings, read from the XML of an SSP."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from .connectors import TYPES, read_transformation
from .elements import Binding, MappingEntry, ParameterValue
from .ssp_files import PackagedFile
from .xml_file import XmlFile, flag, tag_of


def read_bindings(file: XmlFile, element: Any, at: str, component: PackagedFile | None) -> tuple[Binding, ...]:
    """Return the parameter bindings of an element, in their order."""
    found = file.members("ParameterBindings", element, "ParameterBinding", at=at)
    return tuple(_read_binding(file, child, at, component) for child in found)


def _read_binding(file: XmlFile, element: Any, at: str, component: PackagedFile | None) -> Binding:
    file.expect_children(element, "ParameterValues", "ParameterMapping", at=at)
    kind = "application/x-ssp-parameter-set"
    file.expect_type(element, kind, at)
    values = file.part(element, "ParameterValues", file.one("ParameterValues", element), at, component)
    if values is None:
        raise file.error(
            "found a parameter binding with neither a source nor ParameterValues; expected one of them. Export it "
            "again.",
            at,
        )
    mapping, inline = None, file.one("ParameterMapping", element)
    if inline is not None:
        file.expect_type(inline, "application/x-ssp-parameter-mapping", at)
        found = file.part(inline, "ParameterMapping", inline, at, component)
        mapping = () if found is None else tuple(_read_mapping(found, at))
    return Binding(tuple(_read_values(values, at)), mapping, element.get("prefix") or "")


def _read_values(file: XmlFile, at: str) -> Iterator[ParameterValue]:
    """Yield the values of a parameter set."""
    file.expect_children(file.root, "Parameters", "Enumerations", "Units", at=at)
    for element in file.members("Parameters", file.root, "Parameter"):
        name = file.name_of(element, at)
        found = [child for child in file.children(element) if tag_of(child) != "Dimension"]
        if len(found) != 1:
            raise file.error(f"found {len(found)} values of {name!r}; expected one. Export it again.", at)
        tag = file.expect(found[0], *TYPES, at=at)
        text = found[0].get("value")
        if text is None:
            raise file.error(f"found the parameter {name!r} without a value; expected one. Export it again.", at)
        unit, items = file.find_unit(found[0].get("unit")), file.enumerations.get(found[0].get("name", ""), {})
        yield ParameterValue(name, tag, text, unit, file.shape(element, at), items)


def _read_mapping(file: XmlFile, at: str) -> Iterator[MappingEntry]:
    """Yield the entries of a parameter mapping."""
    targets: set[str] = set()
    for element in file.children(file.root):
        file.expect(element, "MappingEntry", at=at)
        source, target = element.get("source"), element.get("target")
        if source is None or not target:
            raise file.error("found a mapping entry without source or target; expected both. Add it.", at)
        if not source:  # a template that was not filled in
            continue
        if target in targets:
            raise file.error(f"found two mapping entries of the target {target!r}; expected one. Leave one out.", at)
        targets.add(target)
        yield MappingEntry(
            source, target, read_transformation(file, element, at), flag(element, "suppressUnitConversion")
        )
