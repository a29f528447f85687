"""File ``modelDescription.xml`` of an FMI 2.0 FMU: all variables are scalars of type Real."""

from __future__ import annotations

from collections.abc import Iterable

from .model_description import DescribedVariable, ModelDescription, Unknown
from .xml_elements import document, element


def write_description2(about: ModelDescription) -> str:
    """Return the text of ``modelDescription.xml`` (FMI 2.0, 2.2)."""
    both = {
        "modelIdentifier": about.name,
        "canNotUseMemoryManagementFunctions": True,
        "canGetAndSetFMUstate": True,
        "canSerializeFMUstate": True,
        "providesDirectionalDerivative": about.has_derivatives,
    }
    sources = element("SourceFiles", {}, [element("File", {"name": "model.c"})])
    types = []
    for kind in about.type_attributes():
        name = kind.pop("name")
        types.append(element("SimpleType", {"name": name}, [element("Real", kind)]))
    children = [
        *(element(interface, both | {**more}, [sources]) for interface, more in about.interfaces.items()),
        *about.definitions(types),
        about.log_categories({"logAll": "All of them"}),
        about.experiment(),
        element("ModelVariables", {}, [_variable(one, about) for one in about.variables]),
        element("ModelStructure", {}, _structure(about)),
    ]
    head = about.head("2.0", "guid") | {"numberOfEventIndicators": len(about.indicators)}
    return document("fmiModelDescription", head, children)


def _variable(one: DescribedVariable, about: ModelDescription) -> str:
    e, v = one.entry, one.entry.variable
    real = one.describe_values(about.types) | {
        "start": v.flat_start[0] if v.flat_start else None,
        "derivative": None if e.of is None else _index(e.of),
        "reinit": one.is_reinitialized or None,
    }
    return element("ScalarVariable", one.attributes, [element("Real", real)])


def _index(reference: int) -> int:
    """Return the index of a variable, which FMI 2.0 counts from 1; value references follow the variables' order."""
    return reference + 1


def _structure(about: ModelDescription) -> list[str]:
    """Return the elements of the model structure (FMI 2.0, 2.2.8).

    Knowns of outputs and derivatives are inputs, continuous states and time only. Initial unknowns are those of FMI
    3.0.
    """
    in_run = {v.entry.reference for v in about.variables if v.entry.kind in ("time", "input", "state")}
    everything = {v.entry.reference for v in about.variables}
    initial = sorted(about.initial, key=lambda one: one.entry.reference)
    return [
        *_unknowns("Outputs", about.outputs, in_run),
        *_unknowns("Derivatives", about.rates, in_run),
        *_unknowns("InitialUnknowns", initial, everything),
    ]


def _unknowns(tag: str, unknowns: Iterable[Unknown], listed: set[int]) -> list[str]:
    """Return the list of some unknowns, with those of their knowns that are listed; nothing for an empty one."""
    rows = []
    for one in unknowns:
        attributes: dict[str, object] = {"index": _index(one.entry.reference)}
        if one.knowns is not None:
            knowns = [d for d in one.knowns if d.known in listed]
            attributes["dependencies"] = " ".join(str(_index(d.known)) for d in knowns)
            attributes["dependenciesKind"] = " ".join(d.kind for d in knowns)
        rows.append(element("Unknown", attributes))
    return [element(tag, {}, rows)] if rows else []
