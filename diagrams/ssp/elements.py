"""Content of a system structure description: systems, components, connectors, connections and parameter bindings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

INPUTS = ("input", "parameter", "structuralParameter")
"""Kinds of connectors whose value comes from outside of their element."""
OUTPUTS = ("output", "local", "calculatedParameter", "constant")
"""Kinds of connectors whose value their element makes."""
INTEGERS = ("Integer", *(f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)))
REALS = ("Real", "Float64", "Float32")

Names = tuple[str, ...]
"""Names of the elements from the root system, which has none itself, down to an element."""


@dataclass(frozen=True)
class Connector:
    """Connector of an element, or entry of a signal dictionary."""

    name: str
    kind: str
    type: str = ""
    """Type as SSP names it; empty where the file states none."""
    unit: str | None = None
    """Unit as this library reads it; None where the file states none."""
    shape: tuple[int, ...] = ()
    items: Mapping[str, int] = field(default_factory=dict)
    """Values of an enumeration by their names."""


@dataclass(frozen=True)
class Transformation:
    """Transformation of a value ahead of its target: factor · value + offset, or a table."""

    factor: float = 1.0
    offset: float = 0.0
    kind: str = "linear"
    """"linear", or the type of the table's values: "boolean", "integer" or "enumeration"."""
    table: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Connection:
    """Connection of two connectors; an end is the name of an element, "" for the system itself, and a connector."""

    start: tuple[str, str]
    end: tuple[str, str]
    transformation: Transformation | None = None
    suppress_units: bool = False

    def __str__(self) -> str:
        return " → ".join(".".join(filter(None, end)) for end in (self.start, self.end))


@dataclass(frozen=True)
class ParameterValue:
    """Value of a parameter as a file has it."""

    name: str
    type: str
    text: str
    unit: str | None = None
    shape: tuple[int, ...] = ()
    items: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class MappingEntry:
    """Name of a parameter of a set, and of the parameter that gets its value."""

    source: str
    target: str
    transformation: Transformation | None = None
    suppress_units: bool = False


@dataclass(frozen=True)
class Binding:
    """Parameter set that is applied to an element."""

    values: tuple[ParameterValue, ...]
    mapping: tuple[MappingEntry, ...] | None = None
    prefix: str = ""


@dataclass(frozen=True)
class Element:
    """Component, signal dictionary reference, or system."""

    name: str
    connectors: Mapping[str, Connector]
    bindings: tuple[Binding, ...] = ()


@dataclass(frozen=True)
class Component(Element):
    """FMU in a system."""

    source: str = ""
    """The source as the file states it."""
    file: Path = Path()
    """The FMU, unpacked."""
    implementation: str = "any"


@dataclass(frozen=True)
class DictionaryReference(Element):
    """Place of a signal dictionary in a system, through whose connectors its signals are written and read."""

    dictionary: str = ""


@dataclass(frozen=True)
class System(Element):
    """System of elements and connections; the root system, a nested one, or one of another file."""

    elements: Mapping[str, Element] = field(default_factory=dict)
    connections: tuple[Connection, ...] = ()
    dictionaries: Mapping[str, Mapping[str, Connector]] = field(default_factory=dict)

    def walk(self, at: Names = ()) -> Iterator[tuple[Names, Element]]:
        """Yield the system and all elements in it, each with its names from the root down."""
        yield at, self
        for name, element in self.elements.items():
            if isinstance(element, System):
                yield from element.walk((*at, name))
            else:
                yield (*at, name), element


@dataclass(frozen=True)
class ProposedExperiment:
    """Simulation that a file proposes: start and end in s, and the step that an annotation of a tool names."""

    start: float | None = None
    stop: float | None = None
    step: float | None = None
