"""Description of an FMU as FMPy reads it, from a text that was checked before."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

from ...blocks.core import FmuFileError
from .archive_limits import ArchiveLimits
from .faults import FmuFault
from .repair import counts_from_zero, repair
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
