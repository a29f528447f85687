"""A diagram of FMUs, written as an SSP."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core import Constant, OptionError, SspFileError, accepts, check_file, kinds, replace_file, same_unit
from ...fmus import Fmu
from ...fmus.archive import FmuDescription, FmuVariable, read_description
from ..flat import WiredDiagram
from ..wiring import Wire
from .documents import (
    WrittenConnection,
    WrittenConnector,
    WrittenElement,
    WrittenValue,
    lay_out,
    needs_version_2,
    write_description,
    write_dictionary,
    write_values,
)
from .exported_parts import Export, build_export, find_export, order_sampled, split_diagram
from .ssp_files import DEFAULT
from .terms import Term, Terms

_TIME = (2020, 1, 1, 0, 0, 0)
"""Time of all files in an archive, so that the same diagram gives the same bytes."""
SET = "parameters"
"""Name of all parameter sets: tools that let a user choose one by its name apply those of all components."""
_IMPLEMENTATIONS = {"co_simulation": "CoSimulation", "model_exchange": "ModelExchange"}
_SIGNALS = ("input", "output")
_SCALARS = "Export the FMU with scalars: build(…, arrays=False), or fmi=2."
"""Step where an array has no place in a connection."""


@dataclass
class WrittenPart:
    """Component that is written."""

    path: str
    """Path of its block, or of the subsystem that becomes it, in the diagram."""
    system: str
    """Path of the system that it is in; empty for the root system."""
    wires: dict[str, Wire]
    """Where its inputs come from, by their ports."""
    element: WrittenElement
    description: FmuDescription
    values: list[WrittenValue] = field(default_factory=list)
    scalars: dict[str, list[str]] = field(default_factory=dict)
    """Variables of each port, in the order of its entries."""


@dataclass
class Writer:
    """A diagram on its way to an SSP; parameters are those of `write_ssp`."""

    wired: WiredDiagram
    flat: bool

    def __post_init__(self) -> None:
        self.table = self.wired.scheduled
        self.root = WrittenElement(self.wired.name)
        self.systems: dict[str, WrittenElement] = {"": self.root}
        self.parts: dict[str, WrittenPart] = {}
        self.inputs: dict[str, WrittenValue] = {}
        self.exports: dict[str, Export] = {}
        self.files: dict[str, Path] = {}
        self._digests: dict[str, str] = {}
        self._borders: dict[tuple[str, str, str, int | None], str] = {}

    def fill(self) -> None:
        """Make the root system with all that is in it.

        Raises `SspFileError`: for a diagram without FMUs, and a block that has no place in an SSP.
        """
        fmus = {path: block for path, block in self.table.blocks.items() if isinstance(block, Fmu)}
        for path, block in sorted(self.table.blocks.items()):
            if block.stepped and path not in fmus:
                raise SspFileError(
                    f"found {block.drawn_as}, which a run steps from outside and which is no FMU; expected FMUs. "
                    "Replace it by an FMU.",
                    block=path,
                )
        if not fmus:
            raise SspFileError(
                "found no FMU in it; expected one at least, as an SSP is a system of FMUs. Build one of the whole: "
                "loopwright.build(diagram).",
                block=self.wired.name,
            )
        # A named constant at the top level is what the system is given: it becomes a value of the SSP's parameter set.
        inputs = (
            set()
            if self.flat
            else {
                path
                for path, block in self.wired.structure.blocks.items()
                if isinstance(block, Constant) and block.name and not self.table.subsystem_of[path]
            }
        )
        self.wired, exported = split_diagram(self.wired, {*fmus}, inputs)
        self.table = self.wired.scheduled
        arrays = any(v.shape for b in fmus.values() for v in b.description.scalars.values() if v.causality in _SIGNALS)
        # Sampled parts come first in the file: a tool that steps components in this order gives their values to the
        # plants at the same instant.
        first = order_sampled(self.table, exported)
        for path in first:
            self._add_export(path, arrays=arrays)
        for path, block in sorted(fmus.items()):
            self._add_fmu(path, block)
        for path in exported:
            if path not in first:
                self._add_export(path, arrays=arrays)
        inside = {p for p in self.table.blocks if any(p.startswith(f"{path}.") for path in exported)}
        self.terms = Terms(self.wired, {*fmus, *inputs, *inside})
        for part in self.parts.values():
            for port, wire in part.wires.items():
                self._wire_port(part, port, wire)
        if not self.flat:
            self._name_outputs()

    # --- components --------------------------------------------------------------------------------------------------

    def _system(self, path: str) -> WrittenElement:
        """Return the system of a subsystem, which is made with those around it."""
        if path not in self.systems:
            settings = self.table.subsystems[path]
            if settings.sample_time is not None or settings.control:
                kind = settings.control or "sampled"
                raise SspFileError(
                    f"found FMUs in a subsystem that is {kind}; expected them outside of it, as a system of an SSP has "
                    "no rate. Take them out.",
                    block=path,
                )
            outer = self._system(path.rpartition(".")[0])
            made = WrittenElement(path.rpartition(".")[2])
            self.systems[path] = outer.elements[made.name] = made
        return self.systems[path]

    def _add_export(self, path: str, *, arrays: bool) -> None:
        """Add the component of a subsystem that becomes an FMU."""
        export = self.exports[path] = find_export(self.wired, path)
        about = read_description(build_export(self.wired, path, arrays=arrays))
        part = self._add_part(path, about, export.inputs)
        for port in {*export.inputs, *(name for name, _ in export.outputs.values())}:
            part.scalars[port] = _scalars(about, port)
        for port, _ in export.outputs.values():
            for scalar in part.scalars[port]:
                self._connector(part, scalar)

    def _add_fmu(self, path: str, block: Fmu) -> None:
        """Add the component of an FMU."""
        about = block.description
        wires = {port: self.table.wires[path, port] for port in block.inputs if (path, port) in self.table.wires}
        part = self._add_part(path, about, wires)
        part.element.implementation = _IMPLEMENTATIONS.get(block.interface or "", "")
        for port, variable in {**block.input_variables, **block.output_variables}.items():
            part.scalars[port] = _scalars(about, variable.name)
        for name, value in block.start.items():
            scalars = _scalars(about, name)
            numbers = np.ravel(value) if scalars != [name] else [value]
            for scalar, number in zip(scalars, numbers, strict=True):
                self._set_value(part, scalar, number)
        for port in block.output_variables:
            for scalar in part.scalars[port]:
                self._connector(part, scalar)

    def _add_part(self, path: str, about: FmuDescription, wires: dict[str, Wire]) -> WrittenPart:
        system, _, name = path.rpartition(".")
        if self.flat:
            system, name = "", path.replace(".", "_")
        element = WrittenElement(name, self._add_file(Path(about.file), about.digest))
        self._system(system).elements[name] = element
        self.parts[path] = WrittenPart(path, system, wires, element, about)
        return self.parts[path]

    def _add_file(self, file: Path, digest: str) -> str:
        """Return the place of an FMU in the archive; FMUs of one content share it."""
        if digest in self._digests:
            return self._digests[digest]
        name, count = f"resources/{file.stem}.fmu", 2
        while name in self.files:
            name, count = f"resources/{file.stem}_{count}.fmu", count + 1
        self.files[name] = file
        self._digests[digest] = name
        return name

    def _set_value(self, part: WrittenPart, name: str, value: Any) -> None:
        about = part.description
        if name in about.other:
            part.values.append(WrittenValue(name, about.other[name].type, value))
            return
        variable = about.find(name)
        shown = value if variable.shape else float(np.ravel(value)[0])
        part.values = [v for v in part.values if v.name != name]
        if variable.start is not None and np.array_equal(shown, np.asarray(variable.start, dtype=float)):
            return  # the FMU's own
        part.values.append(WrittenValue(name, variable.type, shown, variable.unit, variable.items))

    def _connector(self, part: WrittenPart, name: str) -> WrittenConnector:
        if name not in part.element.connectors:
            variable: FmuVariable = part.description.find(name)
            kind = "constant" if variable.variability == "constant" else variable.causality
            part.element.connectors[name] = WrittenConnector(
                name, kind, variable.type, variable.unit, variable.shape, variable.items
            )
        return part.element.connectors[name]

    # --- connections -------------------------------------------------------------------------------------------------

    def _wire_port(self, part: WrittenPart, port: str, wire: Wire) -> None:
        """Write the connections of an input, one for each of its variables; numbers become start values."""
        terms, scalars = self.terms.entries(wire), part.scalars[port]
        if len(scalars) < len(terms):  # an array of FMI 3.0
            joined = self._join(terms)
            if joined is None and any(term.source is not None for term in terms):
                raise SspFileError(
                    "found an array of FMI 3.0 whose entries come from several signals; expected one array, as a "
                    f"connection of an SSP is one of whole arrays. {_SCALARS}",
                    block=part.path,
                    port=port,
                )
            if joined is None:
                self._set_value(part, scalars[0], np.reshape([t.offset for t in terms], self.terms.shape(wire)))
                return
            terms = [joined]
        for name, term in zip(scalars, terms, strict=True):
            if term.source is None:
                variable = part.description.find(name)
                self._set_value(part, name, np.full(variable.shape, term.offset))
                continue
            end = self._connector(part, name)
            self._connect(term, part.system, (part.element.name, name), end)

    def _join(self, terms: Sequence[Term]) -> Term | None:
        """Return the one term of an array, whose entries come from one array in order; None for others."""
        first = terms[0]
        if first.source is None:
            return None
        block, port, _ = first.source
        alike = all(term == replace(first, source=(block, port, i)) for i, term in enumerate(terms))
        size = int(np.prod(self.terms.shape(Wire(block, port))))
        return replace(first, source=(block, port, None)) if alike and size == len(terms) else None

    def _find_output(self, source: tuple[str, str, int | None]) -> tuple[WrittenPart, str, int | None] | None:
        """Return the component that makes a signal, its port, and the entry; None for an input of the root system."""
        path, port, i = source
        outer = next((e for e in self.exports if path.startswith(f"{e}.")), None)
        if outer is not None:
            port, i = self.exports[outer].find(source)
            path = outer
        return (self.parts[path], port, i) if path in self.parts else None

    def _is_array(self, term: Term) -> bool:
        """Whether a term comes from an array of FMI 3.0, which is one connector."""
        found = None if term.source is None else self._find_output(term.source)
        return found is not None and bool(found[0].description.find(found[0].scalars[found[1]][0]).shape)

    def _start(self, source: tuple[str, str, int | None]) -> tuple[str, str, WrittenConnector]:
        """Return the system where a source is, the name of its element, and its connector."""
        found = self._find_output(source)
        if found is not None:
            part, port, i = found
            scalars = part.scalars[port]
            connector = self._connector(part, scalars[i or 0] if len(scalars) > 1 else scalars[0])
            if connector.shape and i is not None:
                raise SspFileError(
                    "found an array of FMI 3.0 of which entries are read one by one; expected readers of the whole, as "
                    f"a connection of an SSP is one of whole arrays. {_SCALARS}",
                    block=part.path,
                    port=port,
                )
            return part.system, part.element.name, connector
        path, port, i = source
        block = self.wired.structure.blocks[path]
        assert isinstance(block, Constant)
        name = path if i is None else f"{path}[{i + 1}]"
        if name not in self.root.connectors:
            value = np.asarray(block.value, dtype=float)
            shown = value if i is None and value.shape else float(np.ravel(value)[i or 0])
            self.root.connectors[name] = WrittenConnector(name, "input", unit=block.unit, shape=np.shape(shown))
            self.inputs[name] = WrittenValue(name, "Float64", shown, block.unit)
        return "", "", self.root.connectors[name]

    def _connect(self, term: Term, system: str, end: tuple[str, str], target: WrittenConnector) -> None:
        """Write a connection, through the borders of systems; its transformation is in the last one."""
        assert term.source is not None
        at, element, connector = self._start(term.source)
        start = (element, connector.name)
        around = _around(system)
        while at not in around:  # out of the systems that hold the source alone
            outer = at.rpartition(".")[0]
            name = self._border(at, term.source, "output")
            if name is None:
                name = self._add_border(at, term.source, connector, "output")
                self.systems[at].connections.append(WrittenConnection(start, ("", name)))
            start, at = (at.rpartition(".")[2], name), outer
        for inner in around[around.index(at) + 1 :]:
            name = self._border(inner, term.source, "input")
            if name is None:
                name = self._add_border(inner, term.source, connector, "input")
                self.systems[at].connections.append(WrittenConnection(start, (inner.rpartition(".")[2], name)))
            start, at = ("", name), inner
        units = connector.unit, target.unit
        differ = units[0] is not None and units[1] is not None and not same_unit(*units)  # type: ignore[arg-type]
        plain = replace(term, source=None)
        self.systems[system].connections.append(WrittenConnection(start, end, plain, differ))

    def _border(self, system: str, source: tuple[str, str, int | None], kind: str) -> str | None:
        return self._borders.get((system, kind, f"{source[0]}.{source[1]}", source[2]))

    def _add_border(
        self, system: str, source: tuple[str, str, int | None], connector: WrittenConnector, kind: str
    ) -> str:
        """Add a connector to a system, by the name that the diagram's subsystem has for this signal."""
        path, port, i = source
        wires = self.table.results if kind == "output" else self.table.arguments
        label = path if path in self.root.connectors else f"{path.rpartition('.')[2]}_{port}"
        for (at, known), wire in wires.items():
            if at == system and (wire.block, wire.port, wire.index) == (path, port, None):
                label = known
        base = name = label if i is None else f"{label}[{i + 1}]"
        count = 2
        while name in self.systems[system].connectors:
            name, count = f"{base}_{count}", count + 1
        made = replace(connector, name=name, kind=kind, place=None)
        self.systems[system].connectors[name] = made
        self._borders[system, kind, f"{path}.{port}", i] = name
        return name

    def _name_outputs(self) -> None:
        """Write the named wires as outputs of their systems, where they come from FMUs."""
        for full, wire in sorted(self.table.names.items()):
            system, _, name = full.rpartition(".")
            if system not in self.systems:
                continue
            terms = self.terms.entries(wire)
            if not all(self._is_readable(term) for term in terms):
                continue
            unit = self.wired.checked.units.get((wire.block, wire.port))
            shape: tuple[int, ...] = ()
            if any(self._is_array(term) for term in terms):
                joined = self._join(terms)
                if joined is None:  # entries of an array, which no connection reads one by one
                    continue
                terms, shape = [joined], self.terms.shape(wire)
            for i, term in enumerate(terms):
                label = name if len(terms) == 1 and (shape or not self.terms.shape(wire)) else f"{name}[{i + 1}]"
                if label in self.systems[system].connectors:
                    continue  # the border of this very signal
                of = unit[i] if isinstance(unit, tuple) else unit
                plain = term.is_plain and term.source is not None
                type_ = self._start(term.source)[2].type if plain and term.source else "Float64"
                made = WrittenConnector(label, "output", type_ if type_ != "Enumeration" else "Int32", of, shape)
                self.systems[system].connectors[label] = made
                self._connect(term, system, ("", label), made)

    def _is_readable(self, term: Term) -> bool:
        """Whether a term comes from an output of a component: an inner signal of an exported subsystem may not."""
        if term.source is None or term.source[0] in self.root.connectors:
            return False
        outer = next((e for e in self.exports.values() if term.source[0].startswith(f"{e.path}.")), None)
        return outer is None or term.source in outer.outputs

    # --- files -------------------------------------------------------------------------------------------------------

    def content(self, stop: float | None, step: float | None) -> Iterator[tuple[str, bytes | Path]]:
        """Yield the files of the archive by their names."""
        connectors = [c for e in _walk(self.root) for c in e.connectors.values()]
        values = [v for part in self.parts.values() for v in part.values]
        version = "2.0" if needs_version_2(connectors, values) else "1.0"
        taken: set[str] = set()
        for part in self.parts.values():
            if part.values:
                part.element.binding = _free(f"resources/{part.element.name}", ".ssv", taken)
                yield part.element.binding, write_values(version, SET, part.values)
        if self.inputs:
            self.root.binding = _free("resources/inputs", ".ssv", taken)
            yield self.root.binding, write_values(version, SET, [*self.inputs.values()])
        signals = [c for c in self.root.connectors.values() if c.kind in _SIGNALS]
        if signals:
            self.root.dictionary = _free("resources/signals", ".ssb", taken)
            yield self.root.dictionary, write_dictionary(version, signals)
        lay_out(self.root)
        yield DEFAULT, write_description(version, self.wired.name, self.root, stop, step)
        yield from self.files.items()


@accepts("{wired.name}", path=kinds.path, flat=kinds.flag)
def write_ssp(
    wired: WiredDiagram,
    path: str | os.PathLike[str],
    *,
    stop: float | None = None,
    step: float | None = None,
    flat: bool = False,
) -> Path:
    """Write a diagram as an SSP, and return the file; see `Diagram.to_ssp`.

    Raises `OptionError`: a path that does not end in ``.ssp``, a folder that isn't there, a time that is not positive.
    Raises `SspFileError`: a block that has no place in it.
    """
    file = check_file(path)
    if file.suffix.lower() != ".ssp":
        raise OptionError(f"found {str(path)!r}; expected a file for an SSP; name it {file.stem}.ssp.", port="path")
    for name, value in (("stop", stop), ("step", step)):
        if value is not None and not (isinstance(value, int | float) and 0.0 < value < float("inf")):
            raise OptionError(f"found {name}={value!r}; expected seconds, such as 10.0. Give them.", port=name)
    writer = Writer(wired, flat)
    writer.fill()
    with replace_file(file) as fresh, zipfile.ZipFile(fresh, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in sorted(writer.content(stop, step), key=lambda item: (item[0] != DEFAULT, item[0])):
            item = zipfile.ZipInfo(name, _TIME)
            item.compress_type = zipfile.ZIP_STORED if name.endswith(".fmu") else zipfile.ZIP_DEFLATED
            item.external_attr = 0o644 << 16
            archive.writestr(item, content if isinstance(content, bytes) else content.read_bytes())
    return file


def _scalars(about: FmuDescription, name: str) -> list[str]:
    """Return the scalars that were gathered into a variable, in the order of its entries; else the variable itself."""
    found = sorted((index, scalar) for scalar, (array, index) in about.elements.items() if array == name)
    return [scalar for _, scalar in found] or [name]


def _walk(element: WrittenElement) -> Iterator[WrittenElement]:
    yield element
    for inner in element.elements.values():
        yield from _walk(inner)


def _around(system: str) -> list[str]:
    """Return the root, and the systems down to one."""
    parts = system.split(".") if system else []
    return ["", *(".".join(parts[: i + 1]) for i in range(len(parts)))]


def _free(base: str, ending: str, taken: set[str]) -> str:
    name, count = f"{base}{ending}", 2
    while name in taken:
        name, count = f"{base}_{count}{ending}", count + 1
    taken.add(name)
    return name
