"""Summary of a third-party FMU, of FMI 1.0 to 3.0, without running it.

A summary consists of dictionaries, lists, numbers and text only, so that it can be written as JSON.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ..archive import DESCRIPTION, ArchiveLimits, FmuArchive, parse_xml, read_model
from ..platform import native_platform
from .libraries import binaries_of, native_binary, tuple_of

INTERFACES = {
    "CoSimulation": "co-simulation",
    "ModelExchange": "model exchange",
    "ScheduledExecution": "scheduled execution",
}
"""Names of the interfaces by their elements in ``modelDescription.xml``."""


def summarize(file: Path, *, limits: ArchiveLimits | None = None, load: bool = True) -> dict[str, Any]:
    """Return a summary of an FMU's description and archive.

    ``load`` says whether another process may load its library to find missing ones, where the system's loader can't be
    asked: elsewhere than on Linux. ``variables`` is a list of dictionaries; ``shape`` of a scalar is an empty list.
    """
    archive, root = open_fmu(file, limits)
    entries = sorted(archive.files)
    model, _ = read_model(file, archive.description(), root, limits)
    fmi = str(model.fmiVersion)
    binaries = binaries_of(entries)
    native = native_platform()
    # FMPy links a derivative to its state by the object itself.
    states = {id(v.derivative) for v in model.modelVariables if v.derivative is not None}
    variables = [_variable(v, id(v) in states) for v in model.modelVariables]
    interfaces = _interfaces(root, model)
    experiment = model.defaultExperiment
    return {
        "file": str(file),
        "size": archive.size,
        "sha256": archive.digest,
        "fmi_version": fmi,
        "model_name": model.modelName,
        "description": model.description or "",
        "version": model.version,
        "author": model.author,
        "license": model.license,
        "copyright": model.copyright,
        "generation_tool": model.generationTool,
        "generation_date_and_time": model.generationDateAndTime,
        "token": model.guid,
        "interfaces": interfaces,
        "default_experiment": {
            key: _value(getattr(experiment, attribute), "Float64")
            for key, attribute in (
                ("start_time", "startTime"),
                ("stop_time", "stopTime"),
                ("step_size", "stepSize"),
                ("tolerance", "tolerance"),
            )
            if getattr(experiment, attribute, None) is not None
        },
        "platforms": {folder: {"platform": tuple_of(folder), "files": names} for folder, names in binaries.items()},
        "native": native_binary(archive, native, binaries, interfaces, load=load),
        "sources": [name for name in entries if name.startswith("sources/")],
        "documentation": any(name.startswith("documentation/") for name in entries),
        "log_categories": [category.name for category in model.logCategories],
        "continuous_states": _count(v for v in variables if v["state"]) or int(model.numberOfContinuousStates or 0),
        "event_indicators": _count(_variable(u.variable, False) for u in model.eventIndicators)
        or int(model.numberOfEventIndicators or 0),
        "variables": variables,
        "python": _needs_python(entries, model.generationTool or ""),
        "notes": _notes(fmi, entries, interfaces, model.generationTool or ""),
    }


def open_fmu(file: Path, limits: ArchiveLimits | None = None) -> tuple[FmuArchive, Any]:
    """Return an FMU's archive and the root element of its ``modelDescription.xml``."""
    archive = FmuArchive.open(file, limits)
    return archive, parse_xml(file, DESCRIPTION, archive.description())


# --- interfaces -----------------------------------------------------------------------------------------------------


def _interfaces(root: Any, model: Any) -> dict[str, dict[str, Any]]:
    """Return the attributes of each interface that the file gives; those left out are false or 0."""
    if model.fmiVersion == "1.0":  # the interface is no element there
        kind = "CoSimulation" if model.coSimulation is not None else "ModelExchange"
        return {kind: {"modelIdentifier": root.get("modelIdentifier")}}
    return {
        kind: {name: value if name == "modelIdentifier" else _flag(value) for name, value in element.attrib.items()}
        for kind in INTERFACES
        if (element := root.find(kind)) is not None
    }


def _flag(text: str) -> Any:
    if text in ("true", "false"):
        return text == "true"
    return _number(text) if text[:1].isdigit() else text


def _needs_python(entries: Iterable[str], tool: str) -> bool:
    return tool.startswith("PythonFMU") or "resources/slavemodule.txt" in set(entries)


def _notes(fmi: str, entries: Iterable[str], interfaces: Mapping[str, Mapping[str, Any]], tool: str) -> list[str]:
    """Return notes on the limits of an FMU's use."""
    notes = []
    if fmi == "1.0":
        notes.append(
            "FMI 1.0 runs here without saved states and exact derivatives. Export it with FMI 3.0 where you can."
        )
    if _needs_python(entries, tool):
        notes.append(
            "It needs Python: its equations are Python code that runs in an interpreter (PythonFMU), with the packages "
            "that they import. On Linux it loads only in a process that has libpython loaded, such as Python's own."
        )
    elif any(attributes.get("needsExecutionTool") in (True, 1) for attributes in interfaces.values()):
        notes.append("It needs another program to run (needsExecutionTool): it is a coupling, not a model.")
    if any(attributes.get("canBeInstantiatedOnlyOncePerProcess") in (True, 1) for attributes in interfaces.values()):
        notes.append("It can be instantiated only once in a process (canBeInstantiatedOnlyOncePerProcess).")
    return notes


# --- variables ------------------------------------------------------------------------------------------------------


def _variable(v: Any, state: bool) -> dict[str, Any]:
    declared = v.declaredType
    numeric = v.type in ("Real", "Integer", "Enumeration") or re.match(r"Float|U?Int", v.type or "") is not None
    return {
        "name": v.name,
        "reference": v.valueReference,
        "type": v.type,
        "shape": _shape(v),
        "causality": v.causality or "local",
        "variability": v.variability,
        "initial": v.initial,
        "state": state,
        "derivative_of": None if v.derivative is None else v.derivative.name,
        "unit": v.unit or (None if declared is None else declared.unit),
        "start": _value(v.start, v.type),
        "min": _value(v.min, v.type) if numeric else None,
        "max": _value(v.max, v.type) if numeric else None,
        "nominal": _value(v.nominal, v.type) if numeric else None,
        "description": v.description or "",
    }


def _shape(variable: Any) -> list[Any]:
    """Return the sizes; a dimension by a structural parameter takes its start value."""
    sizes = [d.start if d.start is not None else getattr(d.variable, "start", None) for d in variable.dimensions or ()]
    return [int(size) if size is not None and str(size).strip().isdigit() else None for size in sizes]


def _count(variables: Iterable[Mapping[str, Any]]) -> int:
    """Return the number of elements of variables."""
    return sum(math.prod(size or 1 for size in v["shape"]) for v in variables)


def _value(text: Any, kind: str | None) -> Any:
    """Return a start value or limit for JSON; a value that is no number in JSON, or can't be read, stays text."""
    if text is None or kind in ("String", "Binary", "Clock"):
        return text
    if isinstance(text, bool | int | float):
        return text if math.isfinite(text) else str(text)
    if isinstance(text, list | tuple):
        return [_value(item, kind) for item in text]
    parts = str(text).split()
    if kind == "Boolean":
        values: list[Any] = [part in ("true", "1") for part in parts]
    else:
        values = [_number(part) for part in parts]
    return values[0] if len(values) == 1 else values


def _number(text: str) -> Any:
    try:
        value = int(text) if re.fullmatch(r"[+-]?\d+", text) else float(text)
    except ValueError:
        return text
    return value if math.isfinite(value) else text
