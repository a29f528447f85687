"""The C sources that an FMU of ours carries, as a part of a unit with other code."""

from __future__ import annotations

import os
import re
import zipfile
from pathlib import Path

from .c_code import RUNTIME, runtime

INCLUDE = re.compile(r'^#include "(.*)"$', re.MULTILINE)
_OURS = re.compile(r"\b(_?(?:lw|LW|casadi|CASADI|eq)_)")
_OF_FMI = ("fmi2", "fmi3")


def read_own_sources(path: str | os.PathLike[str]) -> dict[str, str] | None:
    """Return the C sources of an FMU that this version of Loopwright has built, on any machine; None for another."""
    with zipfile.ZipFile(Path(path)) as archive:
        names = {name.removeprefix("sources/"): name for name in archive.namelist() if name.startswith("sources/")}
        versions = [fmi for fmi in RUNTIME if f"fmi{fmi}.c" in names]
        if "model.c" not in names or len(versions) != 1:
            return None
        sources = {name: archive.read(names[name]).decode() for name in names if name.endswith((".c", ".h"))}
    return sources if {n: text for n, text in sources.items() if n != "model.c"} == runtime(versions[0]) else None


def expand_sources(name: str, sources: dict[str, str], behind: dict[str, str] | None = None) -> str:
    """Return a source with what it includes, but for the functions of FMI.

    ``behind``: texts that come behind sources that are included, by the names of these.
    """

    def include(found: re.Match[str]) -> str:
        if found[1].startswith(_OF_FMI):
            return ""
        return expand_sources(found[1], sources, behind) + (behind or {}).get(found[1], "")

    return INCLUDE.sub(include, sources[name])


def name_apart(text: str, prefix: str) -> str:
    """Return C text with a prefix in front of every name of ours, so that several are in one unit."""
    return _OURS.sub(rf"{prefix}\1", text)
