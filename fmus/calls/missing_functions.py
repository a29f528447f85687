"""Libraries that don't export all functions of the standard."""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

from .bound_calls import ERROR


@cache
def allow_missing(kind: Any, prefix: str, required: tuple[str, ...]) -> Any:
    """Return a class of FMPy's that loads a library without some functions too; their calls return an error.

    Tools leave out functions of capabilities that their FMUs don't have, though the standard asks for all of them.

    Parameters
    ----------
    kind : type
        Class of FMPy's.
    prefix : str
        Prefix of the functions' names.
    required : tuple of str
        Ends of the names of functions without which an FMU can't run.
    """
    needed = {f"{prefix}{name}" for name in required}

    def load(fmu: Any) -> None:
        fmu.missing_functions = set()
        for name in dir(fmu):
            shown = exported_name(name, prefix, fmu.modelIdentifier)
            if name.startswith(prefix) and name not in needed and not hasattr(fmu.dll, shown):
                fmu.missing_functions.add(name)
                setattr(fmu.dll, shown, ctypes.CFUNCTYPE(ctypes.c_int)(lambda: ERROR))
        kind._loadFunctions(fmu)

    return type(kind.__name__, (kind,), {"_loadFunctions": load})  # FMPy reads the version from the class's name


def exported_name(name: str, prefix: str, identifier: str) -> str:
    """Return the name of a function in a library; those of FMI 1.0 begin with the model identifier.

    Examples
    --------
    >>> exported_name("fmi1DoStep", "fmi1", "ball")
    'ball_fmiDoStep'
    """
    return f"{identifier}_{name.replace('fmi1', 'fmi', 1)}" if prefix == "fmi1" else name
