"""Texts of the C files of this folder, and the library that an installation has made of them."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from ..toolchain import native_platform, read_unit, runtime_name

_FOLDER = Path(__file__).parent


def read_sources(*names: str) -> str:
    """Return C sources of this folder, one after the other, with the files that they include in their places."""
    return "\n".join(read_unit(_FOLDER, name) for name in names)


@lru_cache(maxsize=1)
def runtime_source() -> str:
    """Return the C text of the runtime library."""
    return read_sources("runtime.c")


def installed_runtime() -> Path:
    """Return the file of the runtime library that was compiled when the package was installed; it may not be there.

    Its name holds the hash of the source: after a change of a checkout there is none.
    """
    return _FOLDER / "built" / runtime_name(runtime_source(), native_platform())
