"""Rules of descriptions, checked before their variables are read."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

from ...blocks.core import FmuFileError
from .faults import FmuFault
from .limits import ArchiveLimits


def check_schema(root: Any) -> list[str]:
    """Return the places at which a description breaks the standard's schema, which FMPy ships.

    Parameters
    ----------
    root : lxml.etree.Element
        Root of a ``modelDescription.xml`` of FMI 1.0, 2.0 or 3.x.
    """
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


def check_dimensions(path: Path, model: Any, limits: ArchiveLimits) -> None:
    """Refuse variables of impossible or huge shape.

    Parameters
    ----------
    path : Path
        The FMU, for messages.
    model : fmpy.model_description.ModelDescription
        Its description.
    limits : ArchiveLimits
        Limits; `elements` counts.

    Raises
    ------
    FmuFileError
        If a size is negative, or a variable has too many elements.
    """
    for v in model.modelVariables:
        shape = v.shape or ()
        if any(n < 0 for n in shape) or math.prod(shape) > limits.elements:
            sizes = " × ".join(map(str, shape))
            raise FmuFileError(
                f"the variable {v.name!r} of {str(path)!r} has the dimensions {sizes}; expected none below 0, and at "
                f"most {limits.elements} elements. Check the start values of its dimensions, or raise the limit: "
                "limits=ArchiveLimits(elements=…).",
                fault=FmuFault.DIMENSION,
                subject=v.name,
            )
