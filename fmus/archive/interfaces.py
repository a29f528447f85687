"""Interfaces of an FMU as its description states them: capabilities, dependencies, co-simulation, model exchange.

Versions of FMI name the flags differently.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np

from .variables import FmuVariable, fmi3_type

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


def has_flag(interface: Any, name: str) -> bool:
    """Whether an element of a description has a flag; not where there is no such element."""
    return interface is not None and interface.get(name) in ("true", "1")


def state_flags(version: str) -> tuple[str, str]:
    """Return the names of the flags of saving and of serializing the state."""
    state = "FMUState" if version.startswith("3.") else "FMUstate"
    return f"canGetAndSet{state}", f"canSerialize{state}"


def derivatives_flag(version: str) -> str:
    """Return the name of the flag of directional derivatives."""
    return "providesDirectionalDerivatives" if version.startswith("3.") else "providesDirectionalDerivative"


def read_capabilities(interface: Any, version: str) -> dict[str, bool]:
    """Return the capabilities that both interfaces have, co-simulation and model exchange, by the names of fields."""
    saves, serializes = state_flags(version)
    return {
        "can_save": has_flag(interface, saves),
        "can_serialize": has_flag(interface, saves) and has_flag(interface, serializes),
        "has_derivatives": has_flag(interface, derivatives_flag(version)),
        "only_once": has_flag(interface, "canBeInstantiatedOnlyOncePerProcess"),
    }


def read_co_simulation(root: Any, version: str) -> dict[str, Any]:
    """Return the capabilities of co-simulation (FMI 2.0, 4.3.1; FMI 3.0, 4.4), some of which FMPy drops."""
    steps = root.find("Implementation//Capabilities" if version == "1.0" else "CoSimulation")
    two = not version.startswith("3.")
    fixed = None if steps is None or two else steps.get("fixedInternalStepSize")
    experiment = root.find("DefaultExperiment")
    return {
        **read_capabilities(steps, version),
        "has_event_mode": has_flag(steps, "hasEventMode"),
        "interpolates_inputs": has_flag(steps, "canInterpolateInputs" if two else "providesIntermediateUpdate"),
        "variable_step": has_flag(steps, "canHandleVariableCommunicationStepSize"),
        "fixed_internal_step": None if fixed is None else float(fixed),
        "stop_time": None if experiment is None else _number(experiment.get("stopTime")),
        "step_size": None if experiment is None else _number(experiment.get("stepSize")),
    }


def _number(text: str | None) -> float | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return None


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
