"""The C sources that an FMU of ours carries, as a part of a unit with other code, and elementary functions for it."""

from __future__ import annotations

import hashlib
import os
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path

from ..platform import is_built_here
from .c_code import FILES, OF_FMI, read_fmu_sources
from .elementary_tables import prepare_functions, read_fmu_source, restore_functions

_BRANCH_FREE = ("sin", "cos", "tanh")


def inline_model(path: str | os.PathLike[str], prefix: str) -> str | None:
    """Return the equations and the integrators of an FMU as C text for a unit with other code.

    The text defines ``<prefix>lw_inline_step``, see ``fmu_sources/in_loop.c``: a communication step of an instance that
    the FMU's library has made.

    ``path``: an FMU that Loopwright has built on this machine.
    ``prefix``: begin of every name of it, so that several are in one unit.
    Returns: none for an FMU of others, for one with events, and for one of another version of Loopwright, whose
    instances may be laid out otherwise.
    """
    content = Path(path).read_bytes()
    if not is_built_here(hashlib.sha256(content).hexdigest()):
        return None
    sources = read_own_sources(path)
    if sources is None:
        return None
    if "#define LW_N_Z 0\n" not in sources["model.c"]:
        return None
    text = expand_sources("model.c", sources, {"elementary.c": read_fmu_source("fast.c")})
    text += read_fmu_source("in_loop.c")
    return name_apart(_use_fast(text, "lw_any_"), prefix)


def own_functions(text: str, prefix: str) -> tuple[str, str]:
    """Return the C text that goes before and after equations: the elementary functions that they call are our own.

    Sine and cosine hold below 2^20, see ``fmu_sources/fast.c``.
    """
    before = prepare_functions(text)
    if not before:
        return "", ""
    before = INCLUDE.sub(lambda found: read_fmu_sources(3)[found[1]] + read_fmu_source("fast.c"), before)
    return name_apart(_use_fast(before, "lw_fast_"), prefix), restore_functions()


def _use_fast(text: str, begin: str) -> str:
    """Let the names of functions without branches stand for those of elementary.c."""
    for name in _BRANCH_FREE:
        of = begin if name != "tanh" else "lw_fast_"
        text = re.sub(rf"^#define {name} lw_{name}$", f"#define {name} {of}{name}", text, flags=re.MULTILINE)
    return text


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
