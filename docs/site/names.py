"""Pages of the reference that are made of the package: one for each public name, and lists of them."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import re
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from docstrings import escaped

PLACES = (
    "loopwright",
    "loopwright.blocks",
    "loopwright.fmus",
    "loopwright.diagrams",
    "loopwright.frequency",
    "loopwright.sweeps",
    "loopwright.types",
)
"""Modules with public names; a name that several have is described at the first."""

KINDS = {
    "blocks": ("Library of blocks", ""),
    "classes": ("Classes", "Diagrams, runs, models and results: what functions take and return."),
    "functions": ("Functions", "Functions on diagrams, loops, runs and FMUs."),
    "models": ("Modules", "Plants of the library, and the experiments of the paper."),
    "errors": (
        "Errors",
        (
            "Errors by name. The message of each has the block, the port, the time, what was found, what was expected, "
            "and one next step. All are subclasses of ``LoopwrightError``. An error of a run ends it; the samples "
            "until then are in ``error.run``."
        ),
    ),
}
"""Folder of each kind of name, its title, and a sentence on it; blocks are listed by a page of their own."""

_BLOCK = re.compile(r"(?m)^\| `(\w+)` \| (\w+) \| (.*) \|$")
"""A row of the library's page: name, subsystems, description."""

_NO_METHODS_FOR_USERS = (
    "output, derivative, update, indicators, jump, guards, initial, constants, after_start, next_instant, "
    "inputs, outputs, states, events"
)
"""Equations and declarations of a block: its docstring has them as text."""

_SHOWN_WITH_BASES_BELOW = {"Path": "Value"}
"""Classes whose pages have the members of bases that aren't public, too, and the first base that is left out."""

_TABLE = """.. list-table::
   :header-rows: 1
   :widths: 36 64

   * - name, and where to import it from
     - description
"""

_ROW = """   * - :doc:`{name} </reference/{page}>`

       ``{place}``
     - {summary}
"""


@dataclass(frozen=True)
class PublicName:
    """A public name: where it is imported from, and what it is."""

    place: str
    name: str
    made: Any

    @property
    def kind(self) -> str:
        """Folder of its page."""
        from loopwright.blocks import Block

        if isinstance(self.made, ModuleType):
            return "models"
        if not inspect.isclass(self.made):
            return "functions" if callable(self.made) else "classes"
        if issubclass(self.made, BaseException):
            return "errors"
        bases = self.name in ("Block", "Fmu", "PathTracking", "PlanarModel")
        return "blocks" if issubclass(self.made, Block) and not bases else "classes"

    @property
    def summary(self) -> str:
        """First paragraph of its docstring."""
        return " ".join((inspect.getdoc(self.made) or "").partition("\n\n")[0].split())

    @property
    def page(self) -> str:
        """Page of the name, below the reference."""
        return f"{self.kind}/{self.name}"


def public_names() -> list[PublicName]:
    """Return all public names, sorted, each once."""
    modules = [importlib.import_module(place) for place in PLACES if importlib.util.find_spec(place)]
    found: dict[int, PublicName] = {}
    for module in modules:
        for name in getattr(module, "__all__", ()):
            made = getattr(module, name)
            other_name = inspect.isclass(made) and made.__name__ in module.__all__ and made.__name__ != name
            if made not in modules and not isinstance(made, str) and inspect.getdoc(made) and not other_name:
                found.setdefault(id(made), PublicName(module.__name__, name, made))
    return sorted(found.values(), key=lambda public: public.name.lower())


def _title(text: str) -> str:
    return f"{text}\n{'=' * len(text)}\n\n"


def _page(public: PublicName, picture: str) -> str:
    """Return the page of a name."""
    kind, full = KINDS[public.kind][0], f"{public.place}.{public.name}"
    index = "blocks" if public.kind == "blocks" else f"{public.kind}/index"
    where = f":doc:`{kind} </reference/{index}>` · import it from ``{public.place}``\n\n"
    match public.kind:
        case "functions":
            described = f".. autofunction:: {full}\n"
        case "models":
            described = f".. automodule:: {full}\n   :members:\n"
        case "errors":
            described = f".. autoexception:: {full}\n   :members:\n   :show-inheritance:\n"
        case "blocks":
            described = f".. autoclass:: {full}\n   :members:\n   :exclude-members: {_NO_METHODS_FOR_USERS}\n"
        case _:
            described = f".. autoclass:: {full}\n   :members:\n"
            if base := _SHOWN_WITH_BASES_BELOW.get(public.name):
                described += f"   :inherited-members: {base}\n"
    return ":orphan:\n\n" + _title(public.name) + where + picture + described


def _list(kind: str, names: list[PublicName]) -> str:
    """Return the list of all names of a kind."""
    title, sentence = KINDS[kind]
    rows = [
        _ROW.format(name=public.name, page=public.page, place=public.place, summary=escaped(public.summary))
        for public in names
        if public.kind == kind
    ]
    return _title(title) + f"{sentence}\n\n" + _TABLE + "".join(rows)


def _with_pictures(text: str, pictures: dict[str, str]) -> str:
    """Add a column with the responses to the tables of the library's page."""
    text = text.replace(
        "| block | works in | description |\n|---|---|---|\n",
        "| block | works in | description | response |\n|---|---|---|---|\n",
    )

    def widen(row: re.Match[str]) -> str:
        picture = f"![Response of {row[1]}](responses/{row[1]}.svg)" if row[1] in pictures else ""
        return f"{row[0]} {picture} |"

    return _BLOCK.sub(widen, text)


def write(folder: Path, pictures: dict[str, str]) -> None:
    """Write the pages of all public names into the folder of the reference; each with its picture where it has one."""
    names = public_names()
    for kind in KINDS:
        (folder / kind).mkdir(parents=True, exist_ok=True)
        if kind != "blocks":
            (folder / kind / "index.rst").write_text(_list(kind, names), encoding="utf-8")
    library = folder / "blocks.md"
    library.write_text(_with_pictures(library.read_text(encoding="utf-8"), pictures), encoding="utf-8")
    for public in names:
        text = _page(public, pictures.get(public.name, ""))
        (folder / f"{public.page}.rst").write_text(text, encoding="utf-8")
