"""Rules of descriptions, checked before their variables are read."""

from __future__ import annotations

import math
import re
from functools import cache
from pathlib import Path
from typing import Any

from ...blocks.core import FmuFileError
from .archive_limits import ArchiveLimits
from .faults import FmuFault
from .zip_file import DESCRIPTION


def check_schema(root: Any) -> list[str]:
    """Return the places at which a description breaks the standard's schema, which FMPy ships."""
    schema = _schema(root.get("fmiVersion")[0])
    if schema.validate(root):
        return []
    return [f"{e.level_name} (line {e.line}, column {e.column}): {e.message}" for e in schema.error_log]


@cache
def _schema(major: str) -> Any:
    import fmpy
    from lxml import etree

    folder = Path(fmpy.__file__).parent / "schema"
    name = {"1": "fmiModelDescription", "2": "fmi2ModelDescription", "3": "fmi3ModelDescription"}[major]
    return etree.XMLSchema(file=str(folder / f"fmi{major}" / f"{name}.xsd"))


def check_version(path: Path, root: Any) -> None:
    """Refuse a description of an unknown version, or in the form of another version than it states.

    A version 3.x in the form of FMI 3.0 passes, so that its content can be shown.
    """
    version, form = root.get("fmiVersion"), _form(root)
    if not re.fullmatch(KNOWN_VERSIONS, version) and not (version.startswith("3.") and form in ("", "3.0")):
        raise unknown_version(path, version)
    if form and form[0] != version[0]:
        raise FmuFileError(
            f"the {DESCRIPTION} of {str(path)!r} states fmiVersion {version!r}, but is in the form of FMI {form}; "
            f"expected the form of FMI {version}. Export it again, or give it the version that it is written in.",
            fault=FmuFault.DESCRIPTION,
            subject="fmiVersion",
        )


KNOWN_VERSIONS = r"1\.0|2\.0|3\.0(\.\d+)?"


def unknown_version(path: Path, version: str) -> FmuFileError:
    """Return the error of a version of FMI that is not read here."""
    return FmuFileError(
        f"{str(path)!r} is an FMU of FMI {version}; expected FMI 1.0, 2.0 or 3.0. Export it again with one of them, "
        "for co-simulation or model exchange.",
        fault=FmuFault.VERSION,
        subject=version,
    )


def _form(root: Any) -> str:
    """Return the version of FMI in whose form a description is written; empty if nothing says."""
    variable = root.find("ModelVariables/*")
    if variable is None:
        return ""
    if variable.tag != "ScalarVariable":
        return "3.0"
    if root.find("CoSimulation") is not None or root.find("ModelExchange") is not None:
        return "2.0"
    return "1.0" if "modelIdentifier" in root.attrib else ""


def check_structure(path: Path, root: Any) -> None:
    """Refuse a description without variables, or with dimensions by variables that don't exist."""
    variables = root.find("ModelVariables")
    if variables is None:
        raise FmuFileError(
            f"the {DESCRIPTION} of {str(path)!r} has no variables (ModelVariables); expected some. Export it again.",
            fault=FmuFault.DESCRIPTION,
            subject=DESCRIPTION,
        )
    sized = root.xpath("ModelVariables/*/Dimension[@valueReference]")
    known = {v.get("valueReference") for v in variables} if sized else set()
    for dimension in sized:
        reference = dimension.get("valueReference")
        if reference not in known:
            name = dimension.getparent().get("name")
            raise FmuFileError(
                f"the variable {name!r} of {str(path)!r} has the size of the variable with the value reference "
                f"{reference}, which doesn't exist; expected a structural parameter. Export it again.",
                fault=FmuFault.DIMENSION,
                subject=name,
            )


def check_variables(path: Path, root: Any, model: Any, limits: ArchiveLimits) -> list[str]:
    """Refuse variables with one name, or no possible type or shape; return complaints about others."""

    def refuse(fault: FmuFault, name: str, text: str) -> FmuFileError:
        return FmuFileError(f"the variable {name!r} of {str(path)!r} {text}", fault=fault, subject=name)

    if not model.fmiVersion.startswith("3."):
        for element in root.xpath(f"ModelVariables/*[@name and not({' or '.join(_TYPES2)})]"):
            # FMPy would give it the type of the variable before
            text = f"has no type; expected one of {', '.join(_TYPES2)}. Export it again."
            raise refuse(FmuFault.DESCRIPTION, element.get("name"), text)
    check_dimensions(path, model, limits)
    complaints: list[str] = []
    derived = [u.variable for u in model.derivatives]
    states = {v.name for u in derived for v in (u, u.derivative) if v is not None}
    names: set[str] = set()
    by_reference: dict[int, Any] = {}
    for v in model.modelVariables:
        if v.name in names:
            if v.causality != "local" or v.name in states:
                raise FmuFileError(
                    f"{str(path)!r} has two variables {v.name!r}; expected different names. Export it again.",
                    fault=FmuFault.DUPLICATE_NAME,
                    subject=v.name,
                )
            complaints.append(
                f"Two variables have the name {v.name!r} (the second in line {v.sourceline}); the first is read by it."
            )
        names.add(v.name)
        if not 0 <= v.valueReference < 2**32:
            text = f"has the value reference {v.valueReference}; expected 0 to 2**32 - 1. Export it again."
            raise refuse(FmuFault.DUPLICATE_REFERENCE, v.name, text)
        if not model.fmiVersion.startswith("3.") or getattr(v, "alias", None) is not None:
            continue  # variables of one reference are aliases in FMI 2.0 (2.2.7); in FMI 3.0 aliases are elements
        other = by_reference.setdefault(v.valueReference, v)
        if (other.type, other.shape) != (v.type, v.shape):
            text = (
                f"has the value reference {v.valueReference} of {other.name!r}, but another type or shape; expected a "
                "reference of its own. Export it again."
            )
            raise refuse(FmuFault.DUPLICATE_REFERENCE, v.name, text)
    return complaints


_TYPES2 = ("Real", "Integer", "Boolean", "String", "Enumeration")


def check_dimensions(path: Path, model: Any, limits: ArchiveLimits) -> None:
    """Refuse variables with a negative size or too many elements; parameters are those of `check_variables`."""
    for v in model.modelVariables:
        shape = v.shape or ()
        if any(n < 0 for n in shape) or math.prod(shape) > limits.elements:
            sizes = " × ".join(map(str, shape))
            text = (
                f"has the dimensions {sizes}; expected none below 0, and at most {limits.elements} elements. Check the "
                "start values of its dimensions, or raise the limit: limits=ArchiveLimits(elements=…)."
            )
            raise FmuFileError(
                f"the variable {v.name!r} of {str(path)!r} {text}", fault=FmuFault.DIMENSION, subject=v.name
            )
