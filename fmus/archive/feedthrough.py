"""Dependencies of outputs and derivatives as a model structure states them (FMI 2.0, 2.2.8; FMI 3.0, 2.4.8)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from .variables import fmi3_type

Key = tuple[str, int]
"""Type, as FMI 3.0 names it, and value reference of a variable."""
Dependencies = Mapping[Key, frozenset[Key] | None]
"""For each unknown, the variables that it depends on; None: it doesn't say, so all."""


def key_of(variable: Any) -> Key:
    """Return the key of a variable that FMPy has read."""
    return fmi3_type(variable.type), int(variable.valueReference)


def read_dependencies(unknowns: Iterable[Any]) -> dict[Key, frozenset[Key] | None]:
    """Return the variables that each unknown of a model structure depends on, from FMPy's reading of it."""
    return {
        key_of(unknown.variable): None if unknown.dependencies is None else frozenset(map(key_of, unknown.dependencies))
        for unknown in unknowns
    }
