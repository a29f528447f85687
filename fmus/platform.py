"""Platform of this machine, and the cache folder."""

from __future__ import annotations

import os
import platform
import sys
import tempfile
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


def check_cache() -> Path:
    """Return the cache folder, after creating it and writing to it.

    Raises
    ------
    FmuError
        If it can't be written.
    """
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise FmuError(
            f"can't write the cache folder {str(folder)!r}: {error}. Set LOOPWRIGHT_CACHE to a folder that can be "
            "written."
        ) from error
    return folder
