"""The runtime library, loaded: the loops over ticks and time, their methods and events, and the virtual machine."""

from __future__ import annotations

import ctypes
from functools import lru_cache

from ...fmus.runtime import installed_runtime, runtime_source
from ...fmus.toolchain import RUNTIME_FLAGS
from .compiled_libraries import is_kept, load_compiled


@lru_cache(maxsize=1)
def load_runtime() -> ctypes.CDLL:
    """Return the runtime library: that of the installation, else that of the cache, where it is compiled once."""
    try:
        return ctypes.CDLL(str(installed_runtime()))
    except OSError:
        return load_compiled(runtime_source(), RUNTIME_FLAGS)


def runtime_is_kept() -> bool:
    """Whether the runtime library can be loaded without a compiler."""
    return installed_runtime().is_file() or is_kept(runtime_source(), RUNTIME_FLAGS)
