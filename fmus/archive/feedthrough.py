"""Direct feedthrough of an FMU as its model structure states it (FMI 2.0, 2.2.8; FMI 3.0, 2.4.8)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .variables import FmuVariable, fmi3_type

Key = tuple[str, int]
"""Type, as FMI 3.0 names it, and value reference of a variable."""
Feedthrough = Mapping[Key, frozenset[Key] | None]
"""For each output, the variables that it depends on; None: it doesn't say, so all."""


def read_feedthrough(model: Any) -> Feedthrough:
    """Return the variables that each output depends on, from FMPy's reading of a description."""
    return {
        _key(output.variable): None if output.dependencies is None else frozenset(map(_key, output.dependencies))
        for output in model.outputs
    }


def feeds_through(known: Feedthrough, source: FmuVariable, output: FmuVariable) -> bool:
    """Return whether an output may follow an input at once; one that the model structure doesn't list may."""
    sources = {(source.type, reference) for reference in source.references}
    found = [known.get((output.type, reference)) for reference in output.references]
    return any(of is None or bool(of & sources) for of in found)


def _key(variable: Any) -> Key:
    return fmi3_type(variable.type), int(variable.valueReference)
