"""XML of an SSP, read into the classes of `elements`: SSP 1.0 and 2.0.

Elements of the standard that are not known here are errors; annotations, geometry, meta data and elements of other
namespaces are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import unquote

from ...blocks.core import BASE_UNITS, SspFileError, near
from ...fmus.archive import ArchiveLimits, FmuArchive, FmuFault, FmuUnits, parse_xml
from .elements import (
    INTEGERS,
    REALS,
    Binding,
    Component,
    Connection,
    Connector,
    DictionaryReference,
    Element,
    MappingEntry,
    ParameterValue,
    ProposedExperiment,
    System,
    Transformation,
)
from .ssp_files import DEFAULT, Package, PackagedFile, as_ssp_errors, open_package

_SPACE = "http://ssp-standard.org/SSP1/"
_FULL = f"{_SPACE}SystemStructure"
_ROOTS = {
    "Description": "SystemStructureDescription",
    "ParameterValues": "ParameterSet",
    "ParameterMapping": "ParameterMapping",
    "SignalDictionary": "SignalDictionary",
}
"""Root element of each kind of file, by the end of its namespace."""
_LEFT_OUT = {
    "Annotations",
    "ElementGeometry",
    "ConnectorGeometry",
    "ConnectionGeometry",
    "SystemGeometry",
    "GraphicalElements",
    "MetaData",
    "Signature",
}
"""Elements without an effect on values."""
_KINDS = ("input", "output", "inout", "parameter", "calculatedParameter", "structuralParameter", "constant", "local")
_TYPES = {*REALS, *INTEGERS, "Boolean", "String", "Enumeration", "Binary"}
FMU, PACKAGE, DEFINITION = (
    "application/x-fmu-sharedlibrary",
    "application/x-ssp-package",
    "application/x-ssp-definition",
)
_MAPPED = {"BooleanMappingTransformation": "boolean", "IntegerMappingTransformation": "integer"}
_MAPPED["EnumerationMappingTransformation"] = "enumeration"
_DEEPEST = 16
"""Packages and systems within one another that are opened."""
_MOST_ELEMENTS = 10_000
"""Elements of a diagram, of all nested files together."""


@dataclass(frozen=True)
class Parsed:
    """A description that was read, with the files that it refers to."""

    package: Package
    variant: str
    """File of the description in the package."""
    name: str
    version: str
    system: System
    experiment: ProposedExperiment
    tool: str
    notes: tuple[str, ...]


def parse_package(package: Package, variant: str | None = None) -> Parsed:
    """Read a description of a package, with all that it refers to.

    ``variant``: file name of the description, or its name; ``SystemStructure.ssd`` without it.
    Raises `SspFileError` if a file is missing or damaged, breaks the standard, or has something that is not supported
    here.
    """
    return _SspReader().parse_description(_choose(package, variant))


def _choose(package: Package, variant: str | None) -> PackagedFile:
    """Return the description of a package that is asked for."""
    known, file = package.descriptions, str(package.file)
    if not known:
        nested = [name for name in (package.archive.files if package.archive else ()) if name.endswith(".ssd")]
        hint = f" There is {nested[0]}: pack the files in that folder, not the folder." if nested else ""
        raise SspFileError(
            f"{file!r} has no description; expected {DEFAULT} at its root.{hint or ' Export it again.'}",
            fault=FmuFault.NO_DESCRIPTION,
        )
    if variant is None:
        chosen = known[0] if package.archive is None else DEFAULT
        if chosen not in known:
            raise SspFileError(
                f"{file!r} has no {DEFAULT}, only {', '.join(known)}; expected that one. Name one of them: variant=….",
                fault=FmuFault.NO_DESCRIPTION,
            )
        return PackagedFile(package, chosen)
    if variant in known:
        return PackagedFile(package, variant)
    names = {str(PackagedFile(package, name).parse("the package").get("name")): name for name in known}
    if variant in names:
        return PackagedFile(package, names[variant])
    raise SspFileError(
        f"{file!r} has no variant {variant!r}; expected one of {', '.join(map(repr, known))}. "
        f"{near(variant, [*known, *names])}",
        fault=FmuFault.NO_DESCRIPTION,
        subject=variant,
    )


@dataclass
class _SspReader:
    """Reads files; those within one another share the stack of what is open, and the number of elements."""

    stack: list[tuple[Path, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    count: int = 0

    def parse_description(self, place: PackagedFile) -> Parsed:
        """Return a description, with all that it refers to."""
        self.enter(place.package.file, place.name, place)
        root = place.parse("the package")
        file = _File(self, place, root, "Description")
        version = root.get("version", "")
        system = file.one("System", root)
        if system is None:
            raise file.error("found no System; expected the root system. Export it again.")
        for child in file.children(root):
            file.expect(child, "System", "Enumerations", "Units", "DefaultExperiment")
        made = file.system(system, "")
        self.stack.pop()
        return Parsed(
            place.package,
            place.name,
            root.get("name", ""),
            version,
            made,
            file.experiment(file.one("DefaultExperiment", root)),
            root.get("generationTool", ""),
            tuple(dict.fromkeys(self.notes)),
        )

    def enter(self, file: Path, name: str, place: PackagedFile) -> None:
        if (file, name) in self.stack or len(self.stack) >= _DEEPEST:
            chain = " → ".join(name for _, name in self.stack)
            kind = "refers to itself" if (file, name) in self.stack else f"has more than {_DEEPEST} levels"
            raise SspFileError(
                f"{str(place.package.file)!r} {kind}: {chain} → {name}; expected systems within one another, to an "
                "end. Correct the source of the last one.",
                fault=FmuFault.DESCRIPTION,
                subject=name,
            )
        self.stack.append((file, name))


class _File:
    """One file: its place, its units and enumerations, and its elements."""

    def __init__(self, reader: _SspReader, place: PackagedFile, root: Any, kind: str):
        self.reader, self.place, self.root = reader, place, root
        space, _, tag = str(root.tag).rpartition("}")
        known = f"{{{_FULL}{kind}", f"{{{_SPACE}{kind}"  # some tools leave a part out
        if tag != _ROOTS[kind] or space not in known:
            raise self.error(
                f"found the root element {tag!r} of {space[1:] or 'no namespace'!r}; expected {_ROOTS[kind]} of "
                f"{_FULL + kind!r}, as in SSP 1.0 and 2.0. Export it again."
            )
        if space != known[0]:
            reader.notes.append(f"{place.name} has the namespace {space[1:]}; expected {known[0][1:]}")
        version = root.get("version", "")
        if version not in ("1.0", "2.0"):
            raise self.error(f"found version {version!r}; expected 1.0 or 2.0. Export it by one of them.")
        self.units = FmuUnits({u.get("name", ""): self._unit(u) for u in self._listed("Units", "Unit")})
        self.enumerations = {
            e.get("name", ""): {i.get("name", ""): self._whole(i, "value") for i in self.children(e)}
            for e in self._listed("Enumerations", "Enumeration")
        }

    # --- XML ---------------------------------------------------------------------------------------------------------

    def error(self, found: str, element: str = "", fault: FmuFault = FmuFault.DESCRIPTION) -> SspFileError:
        """Return an error in this file, at an element by its names from the root down."""
        where = f"the file {self.place.name} of {str(self.place.package.file)!r}"
        return SspFileError(f"in {where}: {found}", fault=fault, subject=self.place.name, block=element or None)

    def children(self, element: Any) -> Iterator[Any]:
        """Yield the child elements of the standard's namespaces that have an effect."""
        for child in element:
            space, _, tag = str(child.tag).rpartition("}")
            if space.startswith(f"{{{_SPACE}") and tag not in _LEFT_OUT:
                yield child

    def expect(self, child: Any, *known: str, at: str = "") -> str:
        """Return the name of an element that must be one of those known here."""
        tag = _tag(child)
        if tag not in known:
            raise self.error(
                f"found the element {tag!r} in {_tag(child.getparent())!r}, which is not supported here; expected "
                f"{' or '.join(known) or 'none'}. Leave it out, or export by SSP 1.0.",
                at,
            )
        return tag

    def one(self, tag: str, element: Any) -> Any:
        """Return the child element of a name; None without one."""
        return next((child for child in self.children(element) if _tag(child) == tag), None)

    def _listed(self, group: str, tag: str) -> Iterator[Any]:
        found = self.one(group, self.root)
        for child in () if found is None else self.children(found):
            self.expect(child, tag)
            yield child

    def _number(self, element: Any, name: str, default: float | None = None, at: str = "") -> float:
        text = element.get(name)
        if text is None and default is not None:
            return default
        try:
            return float(text)
        except (TypeError, ValueError):
            raise self.error(
                f"found {name}={text!r} in {_tag(element)!r}; expected a number. Export it again.", at
            ) from None

    def _whole(self, element: Any, name: str) -> int:
        text = element.get(name)
        try:
            return int(text)
        except (TypeError, ValueError):
            raise self.error(
                f"found {name}={text!r} in {_tag(element)!r}; expected a whole number. Export it again."
            ) from None

    def _unit(self, element: Any) -> Any:
        base = self.one("BaseUnit", element)
        if base is None:
            return SimpleNamespace(baseUnit=None)
        powers = {name: int(self._number(base, name, 0.0)) for name in BASE_UNITS}
        return SimpleNamespace(
            baseUnit=SimpleNamespace(
                factor=self._number(base, "factor", 1.0), offset=self._number(base, "offset", 0.0), **powers
            )
        )

    def find_unit(self, name: str | None) -> str | None:
        """Return a unit of this file, as this library reads it."""
        found = self.units.find(name)
        if name and found is None:
            self.reader.notes.append(f"the unit {name!r} has no definition here, and is not converted")
        self.reader.notes += [f"{text} in {self.place.name}" for text in self.units.complaints]
        self.units.complaints.clear()
        return found

    def _shape(self, element: Any, at: str) -> tuple[int, ...]:
        sizes = []
        for child in self.children(element):
            if _tag(child) == "Dimension":
                if child.get("size") is None:
                    if child.get("sizeConnector") is None:
                        return ()
                    raise self.error(
                        f"found a dimension by the connector {child.get('sizeConnector')!r}; expected a size. Write "
                        "the number.",
                        at,
                    )
                sizes.append(self._whole(child, "size"))
        return tuple(sizes)

    def name_of(self, element: Any, at: str) -> str:
        """Return the name of an element, which must have one."""
        name = element.get("name")
        if not name:
            raise self.error(f"found a {_tag(element)} without a name; expected one. Export it again.", at)
        return str(name)

    # --- connectors and connections ----------------------------------------------------------------------------------

    def connector(self, element: Any, at: str) -> Connector:
        """Return a connector, or an entry of a signal dictionary."""
        name = self.name_of(element, at)
        where = ".".join(filter(None, (at, name)))
        kind = element.get("kind", "unspecified")
        if kind not in (*_KINDS, "unspecified", "acausal"):
            raise self.error(f"found the kind {kind!r}; expected one of {', '.join(_KINDS)}. Export it again.", where)
        type_, unit, items = "", None, dict[str, int]()
        for child in self.children(element):
            tag = self.expect(child, *_TYPES, "Dimension", at=where)
            if tag == "Dimension":
                continue
            type_, unit = tag, self.find_unit(child.get("unit"))
            if tag == "Enumeration":
                items = self.enumerations.get(child.get("name", ""), {})
        return Connector(
            name, "unspecified" if kind == "acausal" else kind, type_, unit, self._shape(element, where), items
        )

    def connectors(self, element: Any, at: str) -> dict[str, Connector]:
        """Return the connectors of an element by name."""
        group, found = self.one("Connectors", element), dict[str, Connector]()
        for child in () if group is None else self.children(group):
            self.expect(child, "Connector", at=at)
            made = self.connector(child, at)
            if made.name in found:
                raise self.error(f"found two connectors {made.name!r}; expected one. Rename one.", at)
            found[made.name] = made
        return found

    def transformation(self, element: Any, at: str) -> Transformation | None:
        """Return the transformation of a connection or of a mapping entry, if there is one."""
        for child in self.children(element):
            tag = self.expect(child, "LinearTransformation", *_MAPPED, at=at)
            if tag == "LinearTransformation":
                return Transformation(self._number(child, "factor", 1.0, at), self._number(child, "offset", 0.0, at))
            table = [(str(entry.get("source")), str(entry.get("target"))) for entry in self.children(child)]
            if len({source for source, _ in table}) < len(table):
                raise self.error(f"found two entries of one source in {tag}; expected one. Leave one out.", at)
            return Transformation(kind=_MAPPED[tag], table=tuple(table))
        return None

    def connection(self, element: Any, at: str) -> Connection:
        """Return a connection."""
        self.expect(element, "Connection", at=at)
        for side in ("start", "end"):
            if not element.get(f"{side}Connector"):
                raise self.error(f"found a connection without {side}Connector; expected one. Export it again.", at)
            if element.get(f"{side}Indices") is not None:
                raise self.error(
                    f"found {side}Indices={element.get(f'{side}Indices')!r} at a connection, which is not supported "
                    "here; expected connections of whole connectors. Connect the array, or export scalars.",
                    at,
                )
        start, end = (
            (element.get(f"{side}Element") or "", element.get(f"{side}Connector")) for side in ("start", "end")
        )
        return Connection(start, end, self.transformation(element, at), _flag(element, "suppressUnitConversion"))

    # --- parameters --------------------------------------------------------------------------------------------------

    def bindings(self, element: Any, at: str, component: PackagedFile | None) -> tuple[Binding, ...]:
        """Return the parameter bindings of an element, in their order."""
        group = self.one("ParameterBindings", element)
        return () if group is None else tuple(self._binding(child, at, component) for child in self.children(group))

    def _binding(self, element: Any, at: str, component: PackagedFile | None) -> Binding:
        self.expect(element, "ParameterBinding", at=at)
        for child in self.children(element):
            self.expect(child, "ParameterValues", "ParameterMapping", at=at)
        kind = "application/x-ssp-parameter-set"
        self._expect_type(element, kind, at)
        file = self._part(element, "ParameterValues", self.one("ParameterValues", element), at, component)
        if file is None:
            raise self.error(
                "found a parameter binding with neither a source nor ParameterValues; expected one of them. Export it "
                "again.",
                at,
            )
        mapping, inline = None, self.one("ParameterMapping", element)
        if inline is not None:
            self._expect_type(inline, "application/x-ssp-parameter-mapping", at)
            found = self._part(inline, "ParameterMapping", inline, at, component)
            mapping = () if found is None else tuple(found.mapping_entries(at))
        return Binding(tuple(file.parameter_values(at)), mapping, element.get("prefix") or "")

    def _expect_type(self, element: Any, kind: str, at: str) -> None:
        if element.get("type", kind) != kind:
            raise self.error(
                f"found the type {element.get('type')!r} of a {_tag(element)}; expected {kind!r}, the standard's own "
                "format. Write the values in it.",
                at,
            )

    def _part(self, element: Any, kind: str, inline: Any, at: str, component: PackagedFile | None) -> _File | None:
        """Return the file that an element refers to by its source, or that is inside of another element."""
        source = element.get("source")
        if source is None:
            inside = None if inline is None else next(self.children(inline), None)
            return None if inside is None else _File(self.reader, self.place, inside, kind)
        subject = f"{at or 'the root system'}"
        if element.get("sourceBase") == "component":
            if component is None:
                raise self.error(
                    f"found the source {source!r} within the component at an element that is none; expected sourceBase="
                    "'SSD'. Correct it.",
                    at,
                )
            return _File(self.reader, component, self._inside(component, source, subject), kind)
        place = self.place.resolve(source, subject)
        return _File(self.reader, place, place.parse(subject), kind)

    def _inside(self, component: PackagedFile, source: str, subject: str) -> Any:
        """Return the XML of a file inside of an FMU, or inside of another package."""
        path, name = component.path(subject), unquote(source).removeprefix("./")
        with as_ssp_errors():
            archive = FmuArchive.open(path, self.place.package.limits)
            return parse_xml(path, name, archive.read(name, archive.limits.description), "SSP")

    def parameter_values(self, at: str) -> Iterator[ParameterValue]:
        """Yield the values of a parameter set."""
        for element in self.children(self.root):
            self.expect(element, "Parameters", "Enumerations", "Units", at=at)
        for element in self._listed("Parameters", "Parameter"):
            name = self.name_of(element, at)
            found = [child for child in self.children(element) if _tag(child) != "Dimension"]
            if len(found) != 1:
                raise self.error(f"found {len(found)} values of {name!r}; expected one. Export it again.", at)
            tag = self.expect(found[0], *_TYPES, at=at)
            text = found[0].get("value")
            if text is None:
                raise self.error(f"found the parameter {name!r} without a value; expected one. Export it again.", at)
            unit, items = self.find_unit(found[0].get("unit")), self.enumerations.get(found[0].get("name", ""), {})
            yield ParameterValue(name, tag, text, unit, self._shape(element, at), items)

    def mapping_entries(self, at: str) -> Iterator[MappingEntry]:
        """Yield the entries of a parameter mapping."""
        targets: set[str] = set()
        for element in self.children(self.root):
            self.expect(element, "MappingEntry", at=at)
            source, target = element.get("source"), element.get("target")
            if source is None or not target:
                raise self.error("found a mapping entry without source or target; expected both. Add it.", at)
            if not source:  # a template that was not filled in
                continue
            if target in targets:
                raise self.error(
                    f"found two mapping entries of the target {target!r}; expected one. Leave one out.", at
                )
            targets.add(target)
            yield MappingEntry(
                source, target, self.transformation(element, at), _flag(element, "suppressUnitConversion")
            )

    def dictionary_entries(self, at: str) -> dict[str, Connector]:
        """Return the entries of a signal dictionary by name."""
        found: dict[str, Connector] = {}
        for element in self.children(self.root):
            if self.expect(element, "DictionaryEntry", "Enumerations", "Units", at=at) == "DictionaryEntry":
                entry = self.connector(element, at)
                found[entry.name] = replace(entry, kind="inout")
        return found

    # --- elements ----------------------------------------------------------------------------------------------------

    def system(self, element: Any, at: str) -> System:
        """Return a system with all that is in it."""
        for child in self.children(element):
            self.expect(
                child, "Connectors", "ParameterBindings", "Elements", "Connections", "SignalDictionaries", at=at
            )
        elements: dict[str, Element] = {}
        group = self.one("Elements", element)
        for child in () if group is None else self.children(group):
            tag = self.expect(child, "Component", "SignalDictionaryReference", "System", at=at)
            name = self.name_of(child, at)
            path = ".".join(filter(None, (at, name)))
            if name in elements:
                raise self.error(f"found two elements {name!r}; expected one. Rename one.", at)
            # Counted over all files: a few nested references could otherwise ask for millions of elements.
            self.reader.count += 1
            if self.reader.count > _MOST_ELEMENTS:
                raise self.error(f"found more than {_MOST_ELEMENTS} elements; expected fewer. Take a part of it.", path)
            if tag == "Component":
                elements[name] = self.component(child, path)
            elif tag == "System":
                elements[name] = self.system(child, path)
            else:
                elements[name] = DictionaryReference(
                    name, self.connectors(child, path), (), dictionary=child.get("dictionary", "")
                )
        group = self.one("Connections", element)
        connections = () if group is None else tuple(self.connection(child, at) for child in self.children(group))
        group = self.one("SignalDictionaries", element)
        dictionaries: dict[str, Mapping[str, Connector]] = {}
        for child in () if group is None else self.children(group):
            self.expect(child, "SignalDictionary", at=at)
            self._expect_type(child, "application/x-ssp-signal-dictionary", at)
            name = self.name_of(child, at)
            found = self._part(child, "SignalDictionary", child, at, None)
            dictionaries[name] = {} if found is None else found.dictionary_entries(f"{at or 'the root system'}.{name}")
        return System(
            element.get("name", ""),
            self.connectors(element, at),
            self.bindings(element, at, None),
            elements=elements,
            connections=connections,
            dictionaries=dictionaries,
        )

    def component(self, element: Any, at: str) -> Element:
        """Return a component, or the system of the file that it refers to."""
        for child in self.children(element):
            self.expect(child, "Connectors", "ParameterBindings", at=at)
        source, name = element.get("source"), self.name_of(element, at)
        connectors = self.connectors(element, at)
        if source is None:
            raise self.error(
                "found a component without a source, a place for an implementation; expected an FMU. Add its source.",
                at,
            )
        path, _, fragment = source.partition("#")
        ending = Path(unquote(path)).suffix.lower()
        by_ending = {".ssp": PACKAGE, ".ssd": DEFINITION}.get(ending, FMU) if path else DEFINITION
        kind = element.get("type") or by_ending
        if kind not in (FMU, PACKAGE, DEFINITION):
            raise self.error(
                f"found a component of type {kind!r}; expected an FMU or another SSP. Export it as an FMU.", at
            )
        if kind == FMU:
            place = self.place.resolve(path, at)
            bindings = self.bindings(element, at, place)
            implementation = element.get("implementation") or "any"
            return Component(
                name,
                connectors,
                bindings,
                source=source,
                file=place.path(at),
                implementation=implementation,
            )
        inner = self._other_system(path, unquote(fragment), kind, at)
        missing = [n for n in connectors if n not in inner.connectors]
        if missing:
            raise self.error(
                f"found the connector {missing[0]!r}; the system of {source!r} has none of that name; expected one of "
                f"its own. {near(missing[0], inner.connectors)}",
                at,
            )
        bindings = self.bindings(element, at, self.place.resolve(path, at) if path else None)
        return replace(inner, name=name, bindings=(*inner.bindings, *bindings))

    def _other_system(self, path: str, fragment: str, kind: str, at: str) -> System:
        """Return the system of another file, or of another place in this one."""
        reader = self.reader
        if not path:
            found = [e for e in self.root.iter(f"{{{_FULL}Description}}System") if e.get("id") == fragment]
            if len(found) != 1:
                raise self.error(
                    f"found the source '#{fragment}', and {len(found)} systems with that id; expected one. Correct it.",
                    at,
                )
            reader.enter(self.place.package.file, f"{self.place.name}#{fragment}", self.place)
            made = self.system(found[0], at)
            reader.stack.pop()
            return made
        place = self.place.resolve(path, at)
        if kind == DEFINITION:
            return reader.parse_description(place).system
        limits: ArchiveLimits = self.place.package.limits
        inner = open_package(place.path(at), limits)
        return reader.parse_description(_choose(inner, fragment or None)).system

    def experiment(self, element: Any) -> ProposedExperiment:
        """Return the default experiment; its step is that of a tool's annotation."""
        steps = [
            float(text)
            for e in self.root.iter()
            if str(e.tag).rpartition("}")[2] in ("FixedStepAlgorithm", "FixedStepMaster", "FixedStepSolver")
            for text in (e.get("baseStepSize") or e.get("stepSize"),)
            if text and _is_positive(text)
        ]
        step = min(steps) if steps else None
        if element is None:
            return ProposedExperiment(step=step)
        start, stop = (
            None if element.get(name) is None else self._number(element, name) for name in ("startTime", "stopTime")
        )
        return ProposedExperiment(start, stop, step)


def _tag(element: Any) -> str:
    return str(element.tag).rpartition("}")[2]


def _flag(element: Any, name: str) -> bool:
    return element.get(name) in ("true", "1")


def _is_positive(text: str) -> bool:
    try:
        return float(text) > 0.0
    except ValueError:
        return False
