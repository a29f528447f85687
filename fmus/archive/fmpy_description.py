"""Description of an FMU as FMPy reads it, from a text that was checked before.

Where FMPy refuses a description although the FMU can run, the faulty attribute is left out or filled in, and named.
Arrays may get other sizes.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core import FmuFileError
from .archive_limits import ArchiveLimits
from .faults import FmuFault
from .rules import check_schema, check_structure, check_variables, check_version
from .zip_file import DESCRIPTION


def read_model(path: Path, text: bytes, root: Any, limits: ArchiveLimits | None = None) -> tuple[Any, tuple[str, ...]]:
    """Return FMPy's reading of a description, and complaints about rules of the standard that it breaks.

    References that don't exist are taken out of the tree of ``root``.
    """
    from fmpy.validation import validate_model_description
    from lxml import etree

    version = root.get("fmiVersion")
    if root.tag != "fmiModelDescription" or version is None:
        raise FmuFileError(
            f"the {DESCRIPTION} of {str(path)!r} is none: found the element {root.tag!r} "
            f"{'without' if version is None else 'with'} an fmiVersion; expected 'fmiModelDescription' with one. "
            "Export it again.",
            fault=FmuFault.DESCRIPTION,
            subject=DESCRIPTION,
        )
    check_version(path, root)
    check_structure(path, root)
    repaired: list[str] = []
    schema: list[str] = []
    try:
        schema = check_schema(root)
        try:
            if counts_from_zero(root):
                raise IndexError
            model = _read_model(text)
        except Exception:  # FMPy raises bare exceptions
            repaired = repair(root)
            if not repaired:
                raise
            model = _read_model(etree.tostring(root))
        doubles = check_variables(path, root, model, limits or ArchiveLimits())
        complaints = doubles or repaired or schema or validate_model_description(model)
    except FmuFileError:
        raise
    except Exception as error:
        # FMPy words its own refusals; other exceptions are Python's, about lines of FMPy
        found = str(error) if type(error) is Exception else (schema or ["it breaks the rules of the standard"])[0]
        raise FmuFileError(
            f"the {DESCRIPTION} of {str(path)!r} can't be read: {found.rstrip('.')}. Export it again.",
            fault=FmuFault.DESCRIPTION,
            subject=DESCRIPTION,
        ) from error
    return model, tuple(map(str, complaints))


def _read_model(text: bytes) -> Any:
    """Return FMPy's reading of a checked description; FMPy sees nothing else of the archive."""
    import fmpy

    only = io.BytesIO()
    with zipfile.ZipFile(only, "w") as archive:
        archive.writestr(DESCRIPTION, text)
    return fmpy.read_model_description(only, validate=False)


def resize(model: Any, sizes: Mapping[str, int]) -> None:
    """Give structural parameters other values, and arrays the sizes that follow (FMI 3.0, 2.4.7.5).

    FMPy's reading of the description is changed. Start values for each element that don't fit any more are dropped:
    only the FMU knows them.
    """
    if not sizes:
        return
    for v in model.modelVariables:
        if v.name in sizes:
            v.start = str(sizes[v.name])
    for v in model.modelVariables:
        if not any(d.variable is not None and d.variable.name in sizes for d in v.dimensions or ()):
            continue
        v.shape = tuple(int(d.start if d.variable is None else d.variable.start) for d in v.dimensions)
        given = v.start.split() if isinstance(v.start, str) else None
        if given and len(set(given)) == 1:
            v.start = given[0]  # for each element
        elif given and len(given) != np.prod(v.shape, dtype=int):
            v.start = None


# --- repairs ----------------------------------------------------------------------------------------------------------


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
