"""Parameter sets of a system structure, applied in the standard's order (SSP 1.0, 5.1.3; SSP 2.0, 5.2.3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...blocks.core import SspFileError, convert_unit, same_dimension, same_unit
from .dataflow import ConnectorKey
from .elements import INTEGERS, REALS, Component, Names, ParameterValue, System, Transformation
from .parts import FmuPart

_BOOLEANS = {"true": True, "1": True, "false": False, "0": False}


@dataclass(frozen=True)
class Given:
    """Value that a parameter set gives to a connector or a variable."""

    value: ParameterValue
    transformation: Transformation | None = None
    suppress_units: bool = False
    where: str = ""

    def number(self, unit: str | None, items: Mapping[str, int]) -> Any:
        """Return the value in a unit, and an item of an enumeration as its number; a text as a text.

        Raises `SspFileError`: for a value that is none of its type, and a unit of another dimension.
        """
        found, change = self._read(items), self.transformation
        if self.value.type in REALS and unit and self.value.unit and not self.suppress_units:
            if not same_dimension(self.value.unit, unit):
                raise SspFileError(
                    f"found a value in {self.value.unit} for a variable in {unit}; expected one dimension. Correct "
                    "the unit of the parameter set.",
                    block=self.where,
                )
            if not same_unit(self.value.unit, unit):
                factor, offset = convert_unit(self.value.unit, unit)
                found = factor * found + offset
        if change is None:
            return found
        if change.kind == "linear":
            return change.factor * found + change.offset
        table = value_table(change, self.value.items, items, self.where)
        return table.get(float(found), found)

    def _read(self, items: Mapping[str, int]) -> Any:
        value = self.value
        words: list[float]
        try:
            if value.type == "String":
                return value.text
            if value.type == "Binary":
                return bytes.fromhex("".join(value.text.split()))
            if value.type == "Enumeration":
                return self._item(value.text, items)
            if value.type == "Boolean":
                words = [_boolean(word) for word in value.text.split()]
            elif value.type in INTEGERS:
                words = [int(word) for word in value.text.split()]
            else:
                words = [float(word) for word in value.text.split()]
            if not value.shape and len(words) == 1:
                return words[0]
            return np.array(words, dtype=float).reshape(value.shape or (len(words),))
        except (ValueError, IndexError):
            raise SspFileError(
                f"found the value {value.text!r} of the parameter {value.name!r}; expected one of type {value.type}. "
                "Correct the parameter set.",
                block=self.where,
            ) from None

    def _item(self, text: str, items: Mapping[str, int]) -> int:
        known = {**self.value.items, **items}
        return known[text] if text in known else int(text)


def apply_bindings(root: System, parts: Mapping[Names, FmuPart]) -> tuple[dict[ConnectorKey, Given], tuple[str, ...]]:
    """Return the value that each connector and variable gets, and notes. A value may belong to none.

    Bindings of an element are applied in their order; those of a system take precedence over those of what is in it.
    """
    found: dict[ConnectorKey, Given] = {}
    notes = list[str]()
    for names, element in sorted(root.walk(), key=lambda item: -len(item[0])):
        for binding in element.bindings:
            values = {binding.prefix + value.name: value for value in binding.values}
            if binding.mapping is None:
                entries = [(name, Given(value)) for name, value in values.items()]
            else:
                notes += [
                    f"a parameter mapping of {'.'.join(names) or 'the root system'} reads {entry.source!r}, which its "
                    f"parameter set hasn't, so that {entry.target!r} keeps its value"
                    for entry in binding.mapping
                    if entry.source not in values
                ]
                entries = [
                    (entry.target, Given(values[entry.source], entry.transformation, entry.suppress_units))
                    for entry in binding.mapping
                    if entry.source in values
                ]
            for name, given in entries:
                for node in _find_targets(element, names, name, parts):
                    found[node] = Given(given.value, given.transformation, given.suppress_units, str(node))
    return found, tuple(notes)


def _find_targets(element: Any, names: Names, name: str, parts: Mapping[Names, FmuPart]) -> list[ConnectorKey]:
    """Return the connectors and variables of a hierarchical name, relative to an element: several, by punning."""
    if isinstance(element, Component):
        part = parts[names]
        return [ConnectorKey(names, part.canonical(name))] if part.has(name) else []
    if not isinstance(element, System):
        return []
    found = [ConnectorKey(names, name)] if name in element.connectors else []
    for inner, child in element.elements.items():
        if name.startswith(f"{inner}."):
            found += _find_targets(child, (*names, inner), name[len(inner) + 1 :], parts)
    return found


def value_table(
    change: Transformation, source: Mapping[str, int], target: Mapping[str, int], where: str
) -> dict[float, float]:
    """Return the table of a mapping transformation in numbers."""
    readers: dict[str, tuple[Any, Any]] = {
        "boolean": (_boolean, _boolean),
        "integer": (int, int),
        "enumeration": (lambda text: source[text], lambda text: target[text]),
    }
    read = readers[change.kind]
    try:
        return {float(read[0](a)): float(read[1](b)) for a, b in change.table}
    except (ValueError, KeyError) as error:
        raise SspFileError(
            f"found {error.args[0]!r} in a mapping of type {change.kind}; expected values of that type, which the "
            "connectors declare. Correct the entry.",
            block=where,
        ) from None


def _boolean(text: str) -> bool:
    if text not in _BOOLEANS:
        raise ValueError(text)
    return _BOOLEANS[text]
