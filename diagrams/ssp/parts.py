"""FMUs of a system structure: their variables by the connectors' names, and the ports of their blocks."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from ...blocks.core import FmuFileError, SspFileError, near, same_dimension, same_unit
from ...fmus import ArchiveLimits
from ...fmus.archive import FmuDescription, FmuVariable, read_description
from .elements import Component, Connector, Names

_INTERFACES = {"any": None, "CoSimulation": "co_simulation", "ModelExchange": "model_exchange"}


@dataclass
class FmuPart:
    """FMU of a component.

    ``names``: names of the component from the root system down.
    ``read``: variables that are read by a connection and are no outputs: they become ports, too.
    """

    names: Names
    component: Component
    limits: ArchiveLimits
    read: set[str] = field(default_factory=set)
    start: dict[str, Any] = field(default_factory=dict)

    @property
    def path(self) -> str:
        """Its name in messages."""
        return ".".join(self.names)

    @cached_property
    def description(self) -> FmuDescription:
        """The FMU's description."""
        try:
            return read_description(self.component.file, limits=self.limits)
        except FmuFileError as error:
            raise error.at(block=self.path) from None

    @property
    def interface(self) -> str | None:
        """Interface that the file asks for; None for any."""
        asked = self.component.implementation
        if asked not in _INTERFACES:
            raise SspFileError(
                f"found implementation={asked!r}; expected CoSimulation or ModelExchange. Choose one of them.",
                block=self.path,
            )
        return _INTERFACES[asked]

    @cached_property
    def split(self) -> frozenset[str]:
        """Arrays of several dimensions, gathered from scalars, whose scalars are separate ports."""
        gathered = {array for array, _ in self.description.elements.values()}
        return frozenset(a for a in gathered if len(self.description.variables[a].shape) > 1)

    def has(self, name: str) -> bool:
        """Whether a name is that of a variable, which a parameter set may set."""
        about = self.description
        return name in about.names or name in about.aliases or name in about.other

    def canonical(self, name: str) -> str:
        """Return the first name of a variable."""
        return self.description.aliases.get(name, name)

    def variable(self, name: str) -> FmuVariable:
        """Return a variable with numbers as values.

        Raises `SspFileError` if there is none, or if no wire carries it.
        """
        about = self.description
        if name in about.names:
            return about.find(name)
        if name in about.other:
            raise SspFileError(
                f"found a connection of {about.other[name].refusal} Give it by a parameter set, or leave it out.",
                block=self.path,
                port=name,
            )
        raise SspFileError(
            f"found the connector {name!r}; the FMU {self.component.source!r} has no such variable; expected one of "
            f"its own. {near(name, about.names | set(about.texts))}",
            block=self.path,
        )

    def connector(self, name: str) -> Connector:
        """Return a connector, with its kind and unit by the FMU.

        Raises `SspFileError` if the FMU has no such variable, or the file gives it another unit.
        """
        given = self.component.connectors.get(name) or Connector(name, "unspecified")
        own = self.canonical(name)
        if own in self.description.other:
            other = self.description.other[own]
            return replace(given, name=own, kind=other.causality, type=other.type, unit=None)
        variable = self.variable(own)
        kind = "constant" if variable.variability == "constant" else variable.causality
        if kind == "local" and given.kind in ("parameter", "calculatedParameter", "output", "constant"):
            kind = given.kind  # FMI 1.0 has no such causalities
        unit = variable.unit
        if unit is not None and given.unit is not None and not same_unit(unit, given.unit):
            relation = "another factor or offset" if same_dimension(unit, given.unit) else "another dimension"
            raise SspFileError(
                f"found a connector in {given.unit}, of {relation} than {unit}, which the FMU states; expected the "
                "FMU's own unit. Correct the connector's.",
                block=self.path,
                port=name,
            )
        return replace(given, name=own, kind=kind, unit=unit or given.unit, items=variable.items)

    def port(self, name: str) -> tuple[str, int | None, tuple[int, ...]]:
        """Return the port of a variable, its index in the port, and the port's shape."""
        about = self.description
        if name in about.variables:
            return name, None, about.variables[name].shape
        array, index = about.elements[name]
        if array in self.split:
            return name, None, ()
        return array, index[0], about.variables[array].shape

    def members(self, causality: str) -> dict[str, tuple[str, ...]]:
        """Return the ports of a causality, each with its variables in order."""
        about, found = self.description, dict[str, tuple[str, ...]]()
        scalars: dict[str, list[str]] = {}
        for name, (array, _) in sorted(about.elements.items(), key=lambda item: item[1]):
            scalars.setdefault(array, []).append(name)
        for name in about.of(causality):
            if name in self.split:
                found.update({scalar: (scalar,) for scalar in scalars[name]})
            else:
                found[name] = tuple(scalars.get(name, (name,)))
        return found

    @property
    def ports(self) -> list[str] | None:
        """The block's ``ports``; None where all inputs and outputs are its ports as they are."""
        if not self.read and not self.split:
            return None
        return [*self.members("input"), *self.members("output"), *sorted(self.read)]

    def start_of(self, name: str) -> np.ndarray | None:
        """Return the start value of a variable: that of a parameter set, else the FMU's own; None without one."""
        if name in self.start:
            return np.asarray(self.start[name], dtype=float)
        own = self.description.find(name).start
        return None if own is None else np.asarray(own, dtype=float)
