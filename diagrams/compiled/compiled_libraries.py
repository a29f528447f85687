"""Libraries of C code, loaded: generated code, compiled and kept in the user's cache; the runtime, the loop itself."""

from __future__ import annotations

import ctypes
import hashlib
import os
import re
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

from ...blocks.core import CompilerError, replace_file
from ...fmus.export import compile_shared, describe_compiler
from ...fmus.platform import OWN_CACHE, cache_folder, explain_cache_errors, native_platform
from ...fmus.runtime import installed_runtime, runtime_source
from ...fmus.toolchain import DIAGRAM_FLAGS, RUNTIME_FLAGS, SUFFIXES

_OURS = re.compile(r"[0-9a-f]{40}\.(size|so|dll|dylib)")
"""Names of what is in the folder of compiled diagrams; other files there are the user's."""


@lru_cache(maxsize=64)
def load_compiled(source: str, flags: tuple[str, ...] = (), known: str = "") -> ctypes.CDLL:
    """Return the library of a C source, which is compiled unless the cache has it.

    The key in the cache covers the source, the compiler with its version and ``flags`` (after those of every library),
    ``known``, as the processor that flags ask for, and the platform. A library is loaded only from a folder that
    belongs to the user alone.
    """
    library = _library_of(source, flags, known)
    with explain_cache_errors("compiled code can't be kept in the cache", CompilerError):
        if not _is_whole(library):
            compile_shared({"code.c": source}, library, more_flags=(*DIAGRAM_FLAGS, *flags))
            _note_size(library)
    try:
        return ctypes.CDLL(str(library))
    except OSError as error:  # such as a disk from which nothing may be run: the loader gives a text alone
        raise CompilerError(
            f"compiled code can't be loaded from {str(library.parent)!r}: {error}; expected a folder from which "
            f"libraries can be run. {OWN_CACHE}"
        ) from error


def is_kept(source: str, flags: tuple[str, ...] = ()) -> bool:
    """Whether the cache has the library of a C source, so that it needs no compiler's run."""
    return _is_whole(_library_of(source, flags))


def _note_size(library: Path) -> None:
    """Note a library's length next to it; several threads and processes may do so at once."""
    with replace_file(_size_file(library)) as fresh:
        fresh.write_text(str(library.stat().st_size))


def _size_file(library: Path) -> Path:
    return library.with_suffix(".size")


def _is_whole(library: Path) -> bool:
    """Whether a library is in the cache with its full length: to load a part of one ends Python."""
    try:
        return library.stat().st_size == int(_size_file(library).read_text())
    except (OSError, ValueError):
        return False


def _library_of(source: str, flags: tuple[str, ...] = (), known: str = "") -> Path:
    """Return the file of a source's library in the cache, whether it is there or not."""
    platform = native_platform()
    key = hashlib.sha256(
        "\0".join((platform, *describe_compiler(platform), *DIAGRAM_FLAGS, *flags, known, source)).encode()
    ).hexdigest()
    folder = cache_folder() / "compiled"
    with explain_cache_errors("the folder of compiled diagrams can't be made", CompilerError):
        folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        _check_owner(folder)
    return folder / f"{key[:40]}{SUFFIXES[platform.rpartition('-')[2]]}"


def _check_owner(folder: Path) -> None:
    """Refuse a folder that others than the user can write to, and a link to one: what is there is run."""
    if os.name != "posix":
        return
    if folder.is_symlink():
        raise CompilerError(
            f"the folder of compiled diagrams {str(folder)!r} is a link to another one; expected a folder, since what "
            "is there is run. Remove the link, or set LOOPWRIGHT_CACHE to where it leads."
        )
    was_open = folder.stat().st_mode & 0o022
    with suppress(OSError):
        folder.chmod(0o700)
    found = folder.stat()
    if found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise CompilerError(
            f"the folder of compiled diagrams {str(folder)!r} belongs to user {found.st_uid} with permissions "
            f"{found.st_mode & 0o777:o}; expected user {os.getuid()} and 700, since what is there is run. Remove "
            "it, or set LOOPWRIGHT_CACHE to your own folder."
        )
    for file in folder.iterdir() if was_open else ():  # what others may have left there would be run, too
        if _OURS.fullmatch(file.name):
            file.unlink(missing_ok=True)


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
