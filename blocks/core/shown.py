"""Names that completion and ``help`` show of an object: those that a person types, and no plumbing.

They are read from docstrings: the entries of the sections "Attributes" and "Methods" (numpydoc) of a class and its
bases. What a class outside of this package declares is shown, too. Everything else is there as before.
"""

from __future__ import annotations

import inspect
import re
from abc import ABCMeta
from collections.abc import Mapping
from functools import cache

from .errors import close_names, near
from .ports import Port
from .signals import UnknownAttributeError

_MOST_LISTED = 20
"""Members that an error lists where none is near the name that was asked for."""
_PACKAGE = __name__.partition(".")[0]
_SECTION = re.compile(r"^(?:Attributes|Methods)\n-+\n((?:.+\n|\n(?!\S.*\n-+\n))*)", re.MULTILINE)


@cache
def documented(cls: type) -> frozenset[str]:
    """Return the names that the docstrings of a class and its bases list, and those of classes of users."""
    found: set[str] = set()
    for base in cls.__mro__[:-1]:
        for section in _SECTION.finditer(inspect.cleandoc(base.__dict__.get("__doc__") or "") + "\n"):
            entries = re.findall(r"^(\w[^:(\n]*)", section[1], re.MULTILINE)
            found.update(name.strip() for entry in entries for name in entry.split(","))
        if base.__module__.partition(".")[0] not in (_PACKAGE, "typing", "builtins"):
            own = vars(base).items()  # ports follow from the object: not each of them is read as an attribute
            found.update(name for name, value in own if not (name.startswith("_") or isinstance(value, Port)))
    return frozenset(found)


class ShownMembers(ABCMeta):
    """Metaclass: ``help`` and ``dir`` list what a class declares and what is `documented`, no special methods."""

    # It derives from that of abstract classes, so that one may be a second base; ``isinstance`` is the plain one.
    __instancecheck__ = type.__instancecheck__
    __subclasscheck__ = type.__subclasscheck__

    def __dir__(cls) -> list[str]:
        """List public names: those that the class declares itself, and the documented ones of its bases."""
        inherited = {name for base in cls.__mro__[1:] for name in vars(base)}
        own = {name for name in vars(cls) if not name.startswith("_")} - inherited
        return sorted(own | {name for name in documented(cls) if hasattr(cls, name)})


def missing_member(owner: object, name: str, kind: str, ways: Mapping[str, str]) -> AttributeError:
    """Return the error of an attribute that an object, "a run", doesn't have: the way to write it, or near names."""
    if hasattr(type(owner), name):
        object.__getattribute__(owner, name)  # a property that has failed: its own error
    if name.startswith("_"):  # Python and notebooks ask for such names: no one has typed them
        return AttributeError(f"{type(owner).__name__!r} object has no attribute {name!r}")
    known = [member for member in dir(owner) if not member.startswith("_")]
    step = f"Write {ways[name]}." if name in ways else near(name, known)
    if name not in ways and len(known) > _MOST_LISTED and not close_names(name, known):
        step = f"Completion lists its {len(known)} members, as dir(…) does."
    return UnknownAttributeError(f"{kind} has no {name!r}. {step}")
