"""An FMU of our own as C text that is compiled together with a loop, and elementary functions for such code."""

from __future__ import annotations

import hashlib
import os
import re
import zipfile
from importlib import resources
from pathlib import Path

from ..platform import is_built_here
from .c_code import RUNTIME, runtime
from .elementary_tables import FUNCTIONS, prepare_functions

_INCLUDE = re.compile(r'^#include "(.*)"$', re.MULTILINE)
_OURS = re.compile(r"\b(_?(?:lw|LW|casadi|CASADI|eq)_)")
_BRANCH_FREE = ("sin", "cos", "tanh")
_OF_FMI = ("fmi2", "fmi3")


def inline_model(path: str | os.PathLike[str], prefix: str) -> str | None:
    """Return the equations and the integrators of an FMU as C text for a unit with other code.

    The text defines ``<prefix>lw_inline_step``, see ``runtime/in_loop.c``: a communication step of an instance that the
    FMU's library has made.

    Parameters
    ----------
    path : path
        An FMU that Loopwright has built on this machine.
    prefix : str
        Begin of every name of it, so that several are in one unit.

    Returns
    -------
    str or None
        None for an FMU of others, for one with events, and for one of another version of Loopwright, whose instances
        may be laid out otherwise.
    """
    content = Path(path).read_bytes()
    if not is_built_here(hashlib.sha256(content).hexdigest()):
        return None
    with zipfile.ZipFile(path) as archive:
        names = {name.removeprefix("sources/"): name for name in archive.namelist() if name.startswith("sources/")}
        versions = [fmi for fmi in RUNTIME if f"fmi{fmi}.c" in names]
        if "model.c" not in names or len(versions) != 1:
            return None
        sources = {name: archive.read(names[name]).decode() for name in names if name.endswith((".c", ".h"))}
    known = runtime(versions[0])
    if {name: text for name, text in sources.items() if name != "model.c"} != known:
        return None
    if "#define LW_N_Z 0\n" not in sources["model.c"]:
        return None
    text = _expand("model.c", sources) + _read("in_loop.c")
    return _name_apart(_use_fast(text, "lw_any_"), prefix)


def own_functions(text: str, prefix: str) -> tuple[str, str]:
    """Return the C text that goes before and after equations: the elementary functions that they call are our own.

    Sine and cosine hold below 2^20, see ``runtime/fast.c``.
    """
    before = prepare_functions(text)
    if not before:
        return "", ""
    before = _INCLUDE.sub(lambda found: runtime(3)[found[1]] + _read("fast.c"), before)
    after = "".join(f"#undef {name}\n" for name in FUNCTIONS)
    return _name_apart(_use_fast(before, "lw_fast_"), prefix), after


def _read(name: str) -> str:
    return (resources.files(__package__) / "runtime" / name).read_text(encoding="utf-8")


def _expand(name: str, sources: dict[str, str]) -> str:
    """Return a source with what it includes, but for the functions of FMI."""

    def include(found: re.Match[str]) -> str:
        if found[1].startswith(_OF_FMI):
            return ""
        return _expand(found[1], sources) + (_read("fast.c") if found[1] == "elementary.c" else "")

    return _INCLUDE.sub(include, sources[name])


def _use_fast(text: str, begin: str) -> str:
    """Let the names of functions without branches stand for those of elementary.c."""
    for name in _BRANCH_FREE:
        of = begin if name != "tanh" else "lw_fast_"
        text = re.sub(rf"^#define {name} lw_{name}$", f"#define {name} {of}{name}", text, flags=re.MULTILINE)
    return text


def _name_apart(text: str, prefix: str) -> str:
    return _OURS.sub(rf"{prefix}\1", text)
