"""Model exchange as a description states it: capabilities, states, event indicators, dependencies."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from .capabilities import has_flag, read_capabilities
from .feedthrough import Dependencies, Key, key_of, read_dependencies
from .variables import FmuVariable


@dataclass(frozen=True, eq=False)
class ModelExchangeInfo:
    """Model-exchange interface of an FMU (FMI 2.0, 2.2.8 and 3.3.1; FMI 3.0, 2.4.8 and 3.4)."""

    identifier: str
    binary: str = ""
    """The library for this platform, as its path in the archive."""
    can_save: bool = False
    """Whether the state of an instance can be saved and restored."""
    can_serialize: bool = False
    """Whether a saved state can be turned into bytes."""
    has_derivatives: bool = False
    """Whether the FMU computes directional derivatives."""
    only_once: bool = False
    """Whether a process can have one instance only."""
    completes_steps: bool = True
    """Whether it wants to be notified of each step of the solver that was accepted."""
    state_count: int = 0
    """Number of continuous states."""
    indicators: tuple[str, ...] = ()
    """Names of the event indicators."""
    dependencies: Dependencies = field(default_factory=dict)
    """For each output and derivative of a state, the variables that it depends on; None: all. They are by type and
    value reference."""

    time: Key | None = None
    """Type and value reference of the independent variable, if there is one."""

    def varies(self, unknown: FmuVariable) -> bool:
        """Whether an output or a derivative may depend on time by itself; one that is not listed may."""
        found = [self.dependencies.get(key) for key in _keys(unknown)]
        return self.time is None or any(of is None or self.time in of for of in found)

    def pattern(self, unknown: FmuVariable, known: FmuVariable) -> np.ndarray:
        """Return which elements of an output or a derivative may depend on which of an input or a state.

        One that the model structure doesn't list may depend on all.
        """
        found = np.ones((unknown.size, known.size), dtype=bool)
        columns = _keys(known)
        for row, key in enumerate(_keys(unknown)):
            of = self.dependencies.get(key)
            if of is not None:
                found[row] = [column in of for column in columns]
        return found


def _keys(variable: FmuVariable) -> list[Key]:
    """Return type and value reference of each element."""
    keys = [(variable.type, reference) for reference in variable.references]
    return keys if len(keys) == variable.size else keys * variable.size


def read_model_exchange(root: ET.Element, model: Any, binary: str) -> ModelExchangeInfo:
    """Return what a description says of model exchange; ``model`` is FMPy's reading of it."""
    two = not model.fmiVersion.startswith("3.")
    given = root if model.fmiVersion.startswith("1.") else root.find("ModelExchange")
    assert given is not None
    unneeded, needed = "completedIntegratorStepNotNeeded", "needsCompletedIntegratorStep"
    return ModelExchangeInfo(
        identifier=given.get("modelIdentifier", ""),
        binary=binary,
        **read_capabilities(given, model.fmiVersion),
        completes_steps=not has_flag(given, unneeded) if two else has_flag(given, needed),
        state_count=int(model.numberOfContinuousStates),
        indicators=_indicators(model),
        time=next((key_of(v) for v in model.modelVariables if v.causality == "independent"), None),
        dependencies=_read_dependencies(root, model),
    )


def _read_dependencies(root: ET.Element, model: Any) -> dict[Key, frozenset[Key] | None]:
    """Return what outputs and derivatives depend on; in FMI 1.0 outputs name the inputs that they follow."""
    if model.fmiVersion.startswith("1."):
        known = {v.name: v for v in model.modelVariables}
        given = {
            element.get("name"): [name.text for name in found.findall("Name")]
            for element in root.findall("ModelVariables/ScalarVariable")
            if (found := element.find("DirectDependency")) is not None
        }
        return {
            key_of(known[name]): frozenset(key_of(known[of]) for of in names if of in known)
            for name, names in given.items()
            if name in known
        }
    listed = read_dependencies((*model.outputs, *model.derivatives))
    states = [key_of(v.variable.derivative) for v in model.derivatives if v.variable.derivative is not None]
    return {**listed, **{key: frozenset([key]) for key in states}}  # a state follows nothing else at once


def _indicators(model: Any) -> tuple[str, ...]:
    """Return names of the event indicators: those of their variables in FMI 3.0, numbers in FMI 2.0."""
    count = int(model.numberOfEventIndicators)
    names: list[str] = []
    for unknown in model.eventIndicators:
        name, shape = unknown.variable.name, unknown.variable.shape
        names += [f"{name}[{i + 1}]" for i in range(math.prod(map(int, shape)))] if shape else [name]
    if len(names) != count or len(set(names)) != count:
        names = [f"indicator[{i + 1}]" for i in range(count)]
    return tuple(names)
