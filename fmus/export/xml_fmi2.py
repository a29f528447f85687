"""File ``modelDescription.xml`` of an FMI 2.0 FMU: all variables are scalars of type Real.

It depends on the model only, like that of FMI 3.0: it has no time stamp and no random identifier.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from .c_code import Entry, layout
from .model_spec import ModelSpec, naming_convention
from .quantities import type_names
from .xml_fmi3 import (
    Dependency,
    _document,
    _element,
    _reinitialized_states,
    _types,
    _units_and_types,
    dependencies,
    describe_entry,
    describe_values,
    log_categories,
    package_version,
)


def _variable(e: Entry, reinitialized: set[str], types: Mapping[str, str]) -> str:
    v = e.variable
    about = describe_entry(e, "continuous" if e.kind in ("time", "derivative") else v.variability)
    real = describe_values(v, types) | {
        "start": v.flat_start[0] if v.flat_start else None,
        "derivative": None if e.of is None else _index(e.of),
        "reinit": True if e.kind == "state" and e.name in reinitialized else None,
    }
    return _element("ScalarVariable", about, [_element("Real", real)])


def simple_types(types: Mapping[str, str]) -> list[str]:
    """Return the elements of the definitions of types."""
    return [_element("SimpleType", {"name": about.pop("name")}, [_element("Real", about)]) for about in _types(types)]


def _index(reference: int) -> int:
    """Return the index of a variable, which FMI 2.0 counts from 1; value references follow the variables' order."""
    return reference + 1


def _unknowns(
    tag: str,
    chosen: Iterable[Entry],
    found: dict[int, tuple[Dependency, ...]],
    kind: Callable[[Dependency], str | None],
) -> list[str]:
    rows = []
    for e in chosen:
        items = [(_index(d.known), k) for d in found[e.reference] if (k := kind(d)) is not None]
        attributes = {
            "index": _index(e.reference),
            "dependencies": " ".join(str(i) for i, _ in items),
            "dependenciesKind": " ".join(k for _, k in items),
        }
        rows.append(_element("Unknown", attributes))
    return [_element(tag, {}, rows)] if rows else []


def _structure(spec: ModelSpec, entries: tuple[Entry, ...]) -> list[str]:
    """Return the elements of the model structure (FMI 2.0, 2.2.8).

    Knowns of outputs and derivatives are inputs, continuous states and time only. Initial unknowns are those of FMI
    3.0, with "constant" and "dependent" as the only kinds of dependency.
    """
    found = dependencies(spec)
    knowns = {e.reference for e in entries if e.kind in ("time", "input", "state")}

    def kind_in_run(d: Dependency) -> str | None:
        return d.kind if d.known in knowns else None

    def kind_at_start(d: Dependency) -> str:
        return d.kind if d.kind == "constant" else "dependent"

    return [
        *_unknowns("Outputs", [e for e in entries if e.is_output], found, kind_in_run),
        *_unknowns("Derivatives", [e for e in entries if e.kind == "derivative"], found, kind_in_run),
        *_unknowns("InitialUnknowns", [e for e in entries if e.kind in ("derivative", "output")], found, kind_at_start),
    ]


def model_description2(spec: ModelSpec, token: str, *, derivatives: bool) -> str:
    """Return the text of ``modelDescription.xml`` (FMI 2.0, 2.2).

    ``spec``: the model, without arrays (`scalarize`).
    ``derivatives``: whether the binary has directional derivatives.
    """
    entries = layout(spec)
    root = {
        "fmiVersion": "2.0",
        "modelName": spec.name,
        "guid": token,
        "description": spec.description or None,
        "generationTool": f"Loopwright {package_version()}",
        "variableNamingConvention": naming_convention(e.name for e in entries),
        "numberOfEventIndicators": len(spec.events),
    }
    both: dict[str, object] = {
        "modelIdentifier": spec.name,
        "canNotUseMemoryManagementFunctions": True,
        "canGetAndSetFMUstate": True,
        "canSerializeFMUstate": True,
        "providesDirectionalDerivative": derivatives,
    }
    stepping = {
        "canHandleVariableCommunicationStepSize": True,
        "canInterpolateInputs": True,
        "maxOutputDerivativeOrder": 0,
        "canRunAsynchronuously": False,
    }
    sources = _element("SourceFiles", {}, [_element("File", {"name": "model.c"})])
    types = type_names(entries)
    experiment = {
        "startTime": 0.0,
        "stopTime": float(spec.stop_time),
        "tolerance": float(spec.tolerance),
        "stepSize": float(spec.step_size),
    }
    reinitialized = _reinitialized_states(spec)
    children = [
        _element("ModelExchange", both | {"completedIntegratorStepNotNeeded": True}, [sources]),
        _element("CoSimulation", both | stepping, [sources]),
        *_units_and_types(types, simple_types(types)),
        log_categories(2),
        _element("DefaultExperiment", experiment),
        _element("ModelVariables", {}, [_variable(e, reinitialized, types) for e in entries]),
        _element("ModelStructure", {}, _structure(spec, entries)),
    ]
    return _document("fmiModelDescription", root, children)
