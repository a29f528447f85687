"""Descriptions of an SSP, read into the classes of `elements`: systems within systems, and over several files.

First systems and components, then their connectors, connections and signal dictionaries, then parameter bindings with
their sets and mappings.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from ...blocks.core import SspFileError, near
from ...fmus.archive import ArchiveLimits, FmuFault
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
from .ssp_files import DEFAULT, Package, PackagedFile, open_package
from .xml_file import FULL_NAMESPACE, XmlFile, flag, tag_of

FMU, PACKAGE, DEFINITION = (
    "application/x-fmu-sharedlibrary",
    "application/x-ssp-package",
    "application/x-ssp-definition",
)
_DEEPEST = 16
"""Packages and systems within one another that are opened."""
_MOST_ELEMENTS = 10_000
"""Elements of a diagram, of all nested files together."""
_KINDS = ("input", "output", "inout", "parameter", "calculatedParameter", "structuralParameter", "constant", "local")
TYPES = {*REALS, *INTEGERS, "Boolean", "String", "Enumeration", "Binary"}
"""Elements that are the type of a connector or a parameter."""
_MAPPED = {"BooleanMappingTransformation": "boolean", "IntegerMappingTransformation": "integer"}
_MAPPED["EnumerationMappingTransformation"] = "enumeration"


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
        if package.archive is not None and "modelDescription.xml" in package.archive.files:
            hint = f" It is an FMU: write Fmu({file!r})."
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
        file = XmlFile(self.notes, place, root, "Description")
        version = root.get("version", "")
        system = file.one("System", root)
        if system is None:
            raise file.error("found no System; expected the root system. Export it again.")
        file.expect_children(root, "System", "Enumerations", "Units", "DefaultExperiment")
        made = self.system(file, system, "")
        self.stack.pop()
        return Parsed(
            place.package,
            place.name,
            root.get("name", ""),
            version,
            made,
            _read_experiment(file),
            root.get("generationTool", ""),
            tuple(dict.fromkeys(self.notes)),
        )

    def enter(self, file: Path, name: str, place: PackagedFile) -> None:
        """Note that a description is open; one that is open already refers to itself."""
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

    def system(self, file: XmlFile, element: Any, at: str) -> System:
        """Return a system with all that is in it."""
        file.expect_children(
            element, "Connectors", "ParameterBindings", "Elements", "Connections", "SignalDictionaries", at=at
        )
        return System(
            element.get("name", ""),
            _read_connectors(file, element, at),
            _read_bindings(file, element, at, None),
            elements=self._elements(file, element, at),
            connections=tuple(
                _read_connection(file, child, at) for child in file.members("Connections", element, "Connection", at=at)
            ),
            dictionaries=_read_dictionaries(file, element, at),
        )

    def _elements(self, file: XmlFile, element: Any, at: str) -> dict[str, Element]:
        """Return what is in a system, by name."""
        found: dict[str, Element] = {}
        for child in file.members("Elements", element, "Component", "SignalDictionaryReference", "System", at=at):
            tag, name = tag_of(child), file.name_of(child, at)
            path = ".".join(filter(None, (at, name)))
            if name in found:
                raise file.error(f"found two elements {name!r}; expected one. Rename one.", at)
            # Counted over all files: a few nested references could otherwise ask for millions of elements.
            self.count += 1
            if self.count > _MOST_ELEMENTS:
                raise file.error(f"found more than {_MOST_ELEMENTS} elements; expected fewer. Take a part of it.", path)
            if tag == "Component":
                found[name] = self.component(file, child, path)
            elif tag == "System":
                found[name] = self.system(file, child, path)
            else:
                found[name] = DictionaryReference(
                    name, _read_connectors(file, child, path), (), dictionary=child.get("dictionary", "")
                )
        return found

    def component(self, file: XmlFile, element: Any, at: str) -> Element:
        """Return a component, or the system of the file that it refers to."""
        file.expect_children(element, "Connectors", "ParameterBindings", at=at)
        source, name = element.get("source"), file.name_of(element, at)
        connectors = _read_connectors(file, element, at)
        if source is None:
            raise file.error(
                "found a component without a source, a place for an implementation; expected an FMU. Add its source.",
                at,
            )
        path, _, fragment = source.partition("#")
        ending = Path(unquote(path)).suffix.lower()
        by_ending = {".ssp": PACKAGE, ".ssd": DEFINITION}.get(ending, FMU) if path else DEFINITION
        kind = element.get("type") or by_ending
        if kind not in (FMU, PACKAGE, DEFINITION):
            raise file.error(
                f"found a component of type {kind!r}; expected an FMU or another SSP. Export it as an FMU.", at
            )
        if kind == FMU:
            place = file.place.resolve(path, at)
            bindings = _read_bindings(file, element, at, place)
            implementation = element.get("implementation") or "any"
            return Component(
                name,
                connectors,
                bindings,
                source=source,
                file=place.path(at),
                implementation=implementation,
            )
        inner = self._other_system(file, path, unquote(fragment), kind, at)
        missing = [n for n in connectors if n not in inner.connectors]
        if missing:
            raise file.error(
                f"found the connector {missing[0]!r}; the system of {source!r} has none of that name; expected one of "
                f"its own. {near(missing[0], inner.connectors)}",
                at,
            )
        bindings = _read_bindings(file, element, at, file.place.resolve(path, at) if path else None)
        return replace(inner, name=name, bindings=(*inner.bindings, *bindings))

    def _other_system(self, file: XmlFile, path: str, fragment: str, kind: str, at: str) -> System:
        """Return the system of another file, or of another place in this one."""
        if not path:
            found = [e for e in file.root.iter(f"{{{FULL_NAMESPACE}Description}}System") if e.get("id") == fragment]
            if len(found) != 1:
                raise file.error(
                    f"found the source '#{fragment}', and {len(found)} systems with that id; expected one. Correct it.",
                    at,
                )
            self.enter(file.place.package.file, f"{file.place.name}#{fragment}", file.place)
            made = self.system(file, found[0], at)
            self.stack.pop()
            return made
        place = file.place.resolve(path, at)
        if kind == DEFINITION:
            return self.parse_description(place).system
        limits: ArchiveLimits = file.place.package.limits
        inner = open_package(place.path(at), limits)
        return self.parse_description(_choose(inner, fragment or None)).system


def _read_dictionaries(file: XmlFile, element: Any, at: str) -> dict[str, Mapping[str, Connector]]:
    """Return the signal dictionaries of a system, by name."""
    found: dict[str, Mapping[str, Connector]] = {}
    for child in file.members("SignalDictionaries", element, "SignalDictionary", at=at):
        file.expect_type(child, "application/x-ssp-signal-dictionary", at)
        name = file.name_of(child, at)
        part = file.part(child, "SignalDictionary", child, at, None)
        found[name] = {} if part is None else _read_dictionary(part, f"{at or 'the root system'}.{name}")
    return found


def _read_experiment(file: XmlFile) -> ProposedExperiment:
    """Return the default experiment; its step is that of a tool's annotation."""
    steps = [
        float(text)
        for e in file.root.iter()
        if tag_of(e) in ("FixedStepAlgorithm", "FixedStepMaster", "FixedStepSolver")
        for text in (e.get("baseStepSize") or e.get("stepSize"),)
        if text and _is_positive(text)
    ]
    step = min(steps) if steps else None
    element = file.one("DefaultExperiment", file.root)
    if element is None:
        return ProposedExperiment(step=step)
    start, stop = (
        None if element.get(name) is None else file.number(element, name) for name in ("startTime", "stopTime")
    )
    return ProposedExperiment(start, stop, step)


def _is_positive(text: str) -> bool:
    try:
        return float(text) > 0.0
    except ValueError:
        return False


def _read_connector(file: XmlFile, element: Any, at: str) -> Connector:
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


def _read_connectors(file: XmlFile, element: Any, at: str) -> dict[str, Connector]:
    """Return the connectors of an element by name."""
    found: dict[str, Connector] = {}
    for child in file.members("Connectors", element, "Connector", at=at):
        made = _read_connector(file, child, at)
        if made.name in found:
            raise file.error(f"found two connectors {made.name!r}; expected one. Rename one.", at)
        found[made.name] = made
    return found


def _read_transformation(file: XmlFile, element: Any, at: str) -> Transformation | None:
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


def _read_connection(file: XmlFile, element: Any, at: str) -> Connection:
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
    return Connection(start, end, _read_transformation(file, element, at), flag(element, "suppressUnitConversion"))


def _read_dictionary(file: XmlFile, at: str) -> dict[str, Connector]:
    """Return the entries of a signal dictionary by name."""
    found: dict[str, Connector] = {}
    for element in file.children(file.root):
        if file.expect(element, "DictionaryEntry", "Enumerations", "Units", at=at) == "DictionaryEntry":
            entry = _read_connector(file, element, at)
            found[entry.name] = replace(entry, kind="inout")
    return found


def _read_bindings(file: XmlFile, element: Any, at: str, component: PackagedFile | None) -> tuple[Binding, ...]:
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
            source, target, _read_transformation(file, element, at), flag(element, "suppressUnitConversion")
        )
