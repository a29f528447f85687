"""The C sources that an FMU of ours carries, as a part of a unit with other code."""

from __future__ import annotations

import os
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path

from .c_code import FILES, OF_FMI, read_fmu_sources

INCLUDE = re.compile(r'^#include "(.*)"$', re.MULTILINE)
_OURS = re.compile(r"\b(_?(?:lw|LW|casadi|CASADI|eq)_)")


def read_own_sources(path: str | os.PathLike[str]) -> dict[str, str] | None:
    """Return the C sources of an FMU that this version of Loopwright has built, on any machine; None for another."""
    sources = read_packed_sources(path)
    return sources if "model.c" in sources and are_of_this_version(sources) else None


def read_packed_sources(path: str | os.PathLike[str]) -> dict[str, str]:
    """Return the C sources in an FMU of any tool, by name; none where there is no ``model.c``, as ours have.

    Raises `OSError, BadZipFile` if the file can't be read.
    """
    with zipfile.ZipFile(Path(path)) as archive:
        names = [name for name in archive.namelist() if name.startswith("sources/") and name.endswith((".c", ".h"))]
        if "sources/model.c" not in names:
            return {}
        # Sources of other tools have any encoding.
        return {name.removeprefix("sources/"): archive.read(name).decode(errors="replace") for name in names}


def are_of_this_version(sources: Mapping[str, str]) -> bool:
    """Whether the sources around ``model.c`` are those that this version of Loopwright writes."""
    around = {name: text for name, text in sources.items() if name != "model.c"}
    return any(around == read_fmu_sources(fmi) for fmi in FILES)


def expand_sources(name: str, sources: dict[str, str], behind: dict[str, str] | None = None) -> str:
    """Return a source with what it includes, but for the functions of FMI.

    ``behind``: texts that come behind sources that are included, by the names of these.
    """
    of_fmi = {file for files in OF_FMI.values() for file in files}

    def include(found: re.Match[str]) -> str:
        if found[1] in of_fmi:
            return ""
        return expand_sources(found[1], sources, behind) + (behind or {}).get(found[1], "")

    return INCLUDE.sub(include, sources[name])


def name_apart(text: str, prefix: str) -> str:
    """Return C text with a prefix in front of every name of ours, so that several are in one unit."""
    return _OURS.sub(rf"{prefix}\1", text)
