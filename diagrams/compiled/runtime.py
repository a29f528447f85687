"""The runtime library: the loops over ticks and time, their methods, and the virtual machine. It knows no diagram."""

from __future__ import annotations

import ctypes
from functools import lru_cache

from .libraries import is_kept, load_compiled, read_sources

_SOURCES = (
    *("newton.c", "machine.c", "remote.c", "master.c", "exchange.c", "problem.c", "methods.c", "radau.c", "events.c"),
    *("instants.c", "hybrid.c"),
)
_FLAGS = ("-fno-unroll-loops",)  # vectors are short: a sixth less for the compiler


def runtime_source() -> str:
    """Return the C text of the runtime library."""
    return read_sources(*_SOURCES)


@lru_cache(maxsize=1)
def load_runtime() -> ctypes.CDLL:
    """Return the runtime library; it is compiled once on a machine, unless it was installed with the package.

    Raises
    ------
    CompilerError
        If there is no compiler, or it fails.
    FmuError
        If the cache can't be written.
    """
    return load_compiled(runtime_source(), _FLAGS)


def runtime_is_kept() -> bool:
    """Whether the runtime library can be loaded without a compiler."""
    return is_kept(runtime_source(), _FLAGS)
