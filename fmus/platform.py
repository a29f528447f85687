"""Platform of this machine, and the cache folder."""

from __future__ import annotations

import os
import platform
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

import platformdirs

from ..blocks.core import FmuError


def native_platform() -> str:
    """Return this machine's platform as FMI 3.0 names it (2.5.1.4), such as ``x86_64-linux``."""
    machine = platform.machine().lower()
    arch = {"amd64": "x86_64", "x86_64": "x86_64", "arm64": "aarch64", "aarch64": "aarch64"}.get(machine, machine)
    system = {"linux": "linux", "windows": "windows", "darwin": "darwin"}.get(platform.system().lower(), sys.platform)
    return f"{arch}-{system}"


def cache_folder() -> Path:
    """Return the folder of files that can be built again: LOOPWRIGHT_CACHE, else the user's cache folder."""
    given = os.environ.get("LOOPWRIGHT_CACHE")
    return Path(given).expanduser() if given else Path(platformdirs.user_cache_dir("loopwright", appauthor=False))


def record_build(digest: str) -> None:
    """Note in the cache that Loopwright has built a file with this SHA-256 digest, for `is_built_here`."""
    folder = cache_folder() / "built"
    with suppress(OSError):  # a cache that can't be written: the FMU counts as foreign
        folder.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        folder.mkdir(exist_ok=True, mode=0o700)
        (folder / digest).touch(mode=0o600)


def is_built_here(digest: str) -> bool:
    """Return whether Loopwright has built a file with this digest, by a note that only this user can have written."""
    folder = cache_folder() / "built"
    try:
        stats = [(folder / digest).stat(), folder.stat(), folder.parent.stat()]
    except OSError:
        return False
    if os.name != "posix":
        return True
    return all(s.st_uid == os.getuid() and not s.st_mode & 0o022 for s in stats)


def check_cache() -> Path:
    """Return the cache folder, after creating it and writing to it.

    Raises
    ------
    FmuError
        If it can't be written.
    """
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)  # the compiler's own cache stands there, too
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise FmuError(
            f"can't write the cache folder {str(folder)!r}: {error}. Set LOOPWRIGHT_CACHE to a folder that can be "
            "written."
        ) from error
    return folder
