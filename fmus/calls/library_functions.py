"""Functions of an FMU's library: their names, their prototypes, and those that are missing."""

from __future__ import annotations

import ctypes
import inspect
import types
import typing
from functools import cache
from typing import Any, NamedTuple

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
        for name, *_ in list_prototypes(kind, prefix):
            shown = exported_name(name, prefix, fmu.modelIdentifier)
            if name not in needed and not hasattr(fmu.dll, shown):
                fmu.missing_functions.add(name)
                setattr(fmu.dll, shown, ctypes.CFUNCTYPE(ctypes.c_int)(lambda: ERROR))
        bind_functions(fmu, kind, prefix)

    return type(kind.__name__, (kind,), {"_loadFunctions": load})


class Prototype(NamedTuple):
    """A function of the standard: its name in FMPy, and names and C types of its arguments and its result."""

    name: str
    arguments: tuple[str, ...]
    types: tuple[Any, ...]
    result: Any


@cache
def list_prototypes(kind: Any, prefix: str) -> tuple[Prototype, ...]:
    """Return the functions that a class of FMPy's calls, by the annotations of its methods.

    They are read once for a class. FMPy's own ``_loadFunctions`` reads them for each instance, which takes longer than
    to load the library.
    """
    found = []
    for name in sorted(name for name in dir(kind) if name.startswith(prefix)):
        signature = inspect.signature(getattr(kind, name))
        arguments = list(signature.parameters.values())[1:]
        notes = [a.annotation for a in arguments]
        c_types = tuple(typing.get_args(n)[0] if isinstance(n, types.UnionType) else n for n in notes)
        result = {bytes: ctypes.c_char_p, int: ctypes.c_int}.get(signature.return_annotation)
        result = signature.return_annotation if result is None else result
        found.append(Prototype(name, tuple(a.name for a in arguments), c_types, result))
    return tuple(found)


def bind_functions(fmu: Any, kind: Any, prefix: str) -> None:
    """Give the functions of a loaded library their types, and the object of FMPy's class these functions."""
    for name, arguments, c_types, result in list_prototypes(kind, prefix):
        function = getattr(fmu.dll, exported_name(name, prefix, fmu.modelIdentifier))
        function.argnames, function.argtypes, function.restype = list(arguments), list(c_types), result
        fmu._functions[name] = function


def exported_name(name: str, prefix: str, identifier: str) -> str:
    """Return the name of a function in a library; those of FMI 1.0 begin with the model identifier.

    Examples
    --------
    >>> exported_name("fmi1DoStep", "fmi1", "ball")
    'ball_fmiDoStep'
    """
    return f"{identifier}_{name.replace('fmi1', 'fmi', 1)}" if prefix == "fmi1" else name
