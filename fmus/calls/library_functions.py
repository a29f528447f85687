"""Functions of an FMU's library: their names, their prototypes, and those that are missing."""

from __future__ import annotations

import ctypes
import inspect
import types
import typing
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from .bound_calls import ERROR


@cache
def allow_missing(kind: Any, prefix: str, required: tuple[str, ...]) -> Any:
    """Return a class of FMPy's that loads a library without some functions too; their calls return an error.

    Tools leave out functions of capabilities that their FMUs don't have, though the standard asks for all of them.
    ``required`` are the ends of the names of those without which an FMU can't run.
    """

    def load(fmu: Any) -> None:
        fmu._functions = LibraryFunctions(fmu.dll, kind, prefix, fmu.modelIdentifier, required)

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


class LibraryFunctions(dict[str, Any]):
    """Functions of a loaded library by their names in FMPy; one gets its types when it is first asked for.

    A run calls a third of them, and to bind all takes longer than to load the library. One of those that are required
    (see `allow_missing`) and missing is an `AttributeError`. In FMI 1.0 names begin with the model identifier.
    """

    def __init__(self, library: Any, kind: Any, prefix: str, identifier: str, required: tuple[str, ...]):
        super().__init__()
        self._library, self._prefix, self._identifier = library, prefix, identifier
        self._prototypes = {prototype.name: prototype for prototype in list_prototypes(kind, prefix)}
        self._needed = {name for name in map(prefix.__add__, required) if name in self._prototypes}
        self._changes: list[Callable[[str, Any], None]] = []
        for name in sorted(self._needed):
            self[name]

    def lack(self, name: str) -> bool:
        """Whether the library does not export a function, so that its calls return an error."""
        return name in self._prototypes and not hasattr(self._library, self._exported(name))

    def change_each(self, change: Callable[[str, Any], None]) -> None:
        """Call ``change(name, function)`` with each function that is bound, and with others when they are."""
        self._changes.append(change)
        for name, function in self.items():
            change(name, function)

    def __missing__(self, name: str) -> Any:
        prototype, exported = self._prototypes[name], self._exported(name)
        if name in self._needed:
            function: Any = getattr(self._library, exported)
        elif (function := getattr(self._library, exported, None)) is None:
            function = ctypes.CFUNCTYPE(ctypes.c_int)(lambda: ERROR)
        function.argnames, function.argtypes = list(prototype.arguments), list(prototype.types)
        function.restype = prototype.result
        for change in self._changes:
            change(name, function)
        self[name] = function
        return function

    def _exported(self, name: str) -> str:
        return exported_name(name, self._prefix, self._identifier)


def exported_name(name: str, prefix: str, identifier: str) -> str:
    """Return the name of a function in a library; those of FMI 1.0 begin with the model identifier.

    Examples
    --------
    >>> exported_name("fmi1DoStep", "fmi1", "ball")
    'ball_fmiDoStep'
    """
    return f"{identifier}_{name.replace('fmi1', 'fmi', 1)}" if prefix == "fmi1" else name
