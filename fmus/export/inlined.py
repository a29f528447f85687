"""An FMU of our own as C text that is compiled together with a loop, and elementary functions for such code."""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path

from ..platform import is_built_here
from .c_code import read_fmu_sources
from .elementary_tables import prepare_functions, read_fmu_source, restore_functions
from .own_sources import INCLUDE, expand_sources, name_apart, read_own_sources

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
