"""Descriptions that FMPy refuses although the FMU can run: the faulty attribute is left out or filled in, and named."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from typing import Any

_INITIAL = {
    "constant": ("output", "local"),
    "fixed": ("structuralParameter", "parameter", "calculatedParameter", "local"),
    "tunable": ("structuralParameter", "parameter", "calculatedParameter", "local"),
    "discrete": ("input", "output", "local"),
    "continuous": ("input", "output", "local", "independent"),
}
"""Causalities by variability for which the standard has a default of ``initial`` (FMI 2.0, 2.2.7; FMI 3.0, 2.4.7.5)."""


def repair(root: Any) -> list[str]:
    """Take faults out of the tree of a description of FMI 2.0 or 3.0, and return a complaint for each.

    They are references to types, variables and dependencies that don't exist, and combinations of causality and
    variability that the standard doesn't know.
    """
    two = root.get("fmiVersion", "").startswith("2.")
    variables = [v for v in root.iterfind("ModelVariables/*") if v.get("name") is not None]
    if two:
        references: Collection[int] = range(1, len(variables) + 1)
    else:
        references = {int(text) for v in variables if (text := v.get("valueReference", "")).isdecimal()}
    types = {t.get("name") for t in root.iterfind("TypeDefinitions/*")}

    def known(text: str | None) -> bool:
        return text is not None and text.strip().isdecimal() and int(text) in references

    complaints = []
    for v in variables:
        complaints += list(_repair_variable(v, types, known))
    structure = root.find("ModelStructure")
    for unknown in [] if structure is None else [e for e in structure.iter() if e.tag not in _GROUPS]:
        complaints += list(_repair_unknown(unknown, "index" if two else "valueReference", known))
    return complaints


def counts_from_zero(root: Any) -> bool:
    """Whether a model structure of FMI 2.0 has an index below 1, which FMPy takes for one from the end of the list."""
    if not root.get("fmiVersion", "").startswith("2."):
        return False
    texts = (
        text
        for unknown in root.iterfind("ModelStructure/*/Unknown")
        for text in (unknown.get("index", ""), *unknown.get("dependencies", "").split())
    )
    return any(text.lstrip("+-").isdecimal() and int(text) < 1 for text in texts)


_GROUPS = {"ModelStructure", "Outputs", "Derivatives", "InitialUnknowns", "DiscreteStates"}
Known = Callable[[str | None], bool]


def _repair_variable(v: Any, types: Collection[str | None], known: Known) -> Iterator[str]:
    who = f"The variable {v.get('name')!r} (line {v.sourceline})"
    for element in (v, *v):
        declared = element.get("declaredType")
        if declared is not None and declared not in types:
            del element.attrib["declaredType"]
            yield f"{who} is of the type {declared!r}, which is not defined."
        derivative = element.get("derivative")
        if derivative is not None and not known(derivative):
            del element.attrib["derivative"]
            yield f"{who} is the derivative of variable {derivative}, which doesn't exist."
    clocks = v.get("clocks")
    if clocks is not None and not all(known(text) for text in clocks.split()):
        del v.attrib["clocks"]
        yield f"{who} ticks with the clocks {clocks}, of which some don't exist."
    causality, variability = v.get("causality", "local"), v.get("variability")
    if variability is not None and v.get("initial") is None and causality not in _INITIAL.get(variability, ()):
        started = any("start" in element.attrib for element in (v, *v)) or bool(v.xpath("Start"))
        v.set("initial", "exact" if started else "calculated")
        yield f"{who} has an illegal combination of causality {causality!r} and variability {variability!r}."


def _repair_unknown(unknown: Any, key: str, known: Known) -> Iterator[str]:
    where = f"ModelStructure (line {unknown.sourceline})"
    if not known(unknown.get(key)):
        unknown.getparent().remove(unknown)
        yield f"{where} lists the {key} {unknown.get(key)}, which doesn't exist."
        return
    dependencies = unknown.get("dependencies")
    if dependencies is not None and not all(known(text) for text in dependencies.split()):
        for name in ("dependencies", "dependenciesKind"):
            unknown.attrib.pop(name, None)  # then it depends on all, as without the attribute
        yield f"{where} has the dependencies {dependencies[:60]}, of which some don't exist."
