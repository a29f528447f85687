"""Public names of a package: loaded when they are used (PEP 562), and looked for elsewhere where a name is wrong.

A package lists its names in a stub (``__init__.pyi``, or ``NAME.pyi`` next to ``NAME.py``), where type checkers read
them. lazy-loader takes names from within the package alone; ours come from its neighbours, too.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from importlib import import_module
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

from .names_of_other_tools import WAYS

ROOT = __name__.partition(".")[0]
PLACES = (ROOT, *(f"{ROOT}.{name}" for name in ("blocks", "fmus", "diagrams", "frequency", "sweeps", "types")))
"""The modules that users import from; of two that have a name, an error offers the first."""


def load_on_use(name: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a module, by its ``__name__`` and ``__file__``."""
    path = Path(file)
    package = name if path.stem == "__init__" else name.rpartition(".")[0]
    tree = ast.parse(path.with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = (node for node in tree.body if isinstance(node, ast.ImportFrom))
    sources = {alias.name: f"{'.' * node.level}{node.module or ''}" for node in imports for alias in node.names}
    names = sorted(sources)
    vars(sys.modules[name]).setdefault("__path__", [])  # as of a package: see _FinderOfMissingNames

    def load(wanted: str) -> Any:
        if wanted not in sources:
            raise AttributeError(explain_missing(name, wanted) or f"module {name!r} has no attribute {wanted!r}")
        source = sources[wanted]
        if source.strip("."):
            found = getattr(import_module(source, package), wanted)
        else:
            found = import_module(f"{source}{wanted}", package)
        if isinstance(found, ModuleType) and hasattr(found, "__all__"):  # also one that was imported before
            vars(found).setdefault("__dir__", found.__all__.copy)  # completion shows no import of it
        vars(sys.modules[name])[wanted] = found
        return found

    return load, names.copy, names


def explain_missing(module: str, name: str) -> str:
    """Return where a name is that a public module does not have, or its near names; empty where nothing is known."""
    if module not in PLACES or name.startswith("__"):
        return ""
    names = {place: import_module(place).__all__ for place in PLACES}
    found = f"{module} has no {name!r}"
    if name in WAYS:
        return f"{found}. {WAYS[name]}"
    places = [place for place in PLACES if name in names[place]]
    if places:
        return f"{found}: it is in {places[0]} (from {places[0]} import {name})."
    for nearby in ([module], PLACES):
        known = {public.casefold(): (place, public) for place in reversed(nearby) for public in names[place]}
        close = [known[folded] for folded in get_close_matches(name.casefold(), known, n=3, cutoff=0.75)]
        if close:
            offers = (public if place == module else f"{public} of {place}" for place, public in close)
            return f"{found}. Did you mean {' or '.join(offers)}?"
    return ""


class _FinderOfMissingNames:
    """Last finder of modules: it finds none, and raises an error for a name that a public module does not have.

    ``from package import name`` looks for a module ``package.name`` where the package has no such attribute; the text
    of that attribute's error is lost.
    """

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        module, _, name = fullname.rpartition(".")
        text = explain_missing(module, name)
        if text:
            raise ImportError(text, name=module)
        return None


def explain_missing_names() -> None:
    """Make the import of a name that a public module does not have raise an error that says where it is."""
    if not any(type(finder).__name__ == _FinderOfMissingNames.__name__ for finder in sys.meta_path):
        sys.meta_path.append(_FinderOfMissingNames())
