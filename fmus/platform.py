"""Platform of this machine, and the cache folder."""

from __future__ import annotations

import os
import tempfile
from contextlib import AbstractContextManager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import platformdirs

from ..blocks.core import FmuError, LoopwrightError, explain_disk_errors
from .toolchain import native_platform as native_platform

OWN_CACHE = "Set LOOPWRIGHT_CACHE to your own folder."
"""Step where the cache folder can't be used."""


def cache_folder() -> Path:
    """Return the folder of files that can be built again: LOOPWRIGHT_CACHE, else the user's cache folder.

    Its path is absolute, since the working folder changes for moments.
    """
    given = os.environ.get("LOOPWRIGHT_CACHE")
    try:
        folder = Path(given).expanduser() if given else _user_cache(*map(os.environ.get, _USER))
    except RuntimeError:  # "~", for a user whom the system doesn't know
        folder = Path("~")
    if folder.parts[:1] == ("~",):
        raise FmuError(
            "found no home folder for the cache, neither by HOME nor by the system's list of users; expected one. "
            f"{OWN_CACHE}"
        )
    if folder.is_absolute():
        return folder
    with explain_disk_errors(f"the cache folder {str(folder)!r} can't be found", folder, OWN_CACHE, FmuError):
        return folder.absolute()


_USER = ("LOCALAPPDATA", "USERPROFILE", "HOME") if os.name == "nt" else ("HOME", "XDG_CACHE_HOME")
"""Environment variables by which a user's cache folder is found."""


@lru_cache(maxsize=16)
def _user_cache(*found_by: str | None) -> Path:
    """Return the user's cache folder, which is looked for again when one of `_USER` has another value."""
    return Path(platformdirs.user_cache_dir("loopwright", appauthor=False))


def explain_cache_errors(
    failed: str = "", raised: type[LoopwrightError] = FmuError, **where: Any
) -> AbstractContextManager[None]:
    """Return a context in which an error of the system is explained as one of the cache folder.

    Parameters are those of `explain_disk_errors`; without ``failed`` the message says that the cache can't be used.
    """
    folder = cache_folder()
    failed = failed or f"the cache folder {str(folder)!r} can't be used"
    return explain_disk_errors(failed, folder, OWN_CACHE, raised, **where)


def record_build(digest: str) -> None:
    """Note in the cache that Loopwright has built a file with this SHA-256 digest, for `is_built_here`."""
    with suppress(OSError, FmuError):  # a cache that can't be written: the FMU counts as foreign
        folder = cache_folder() / "built"
        folder.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        folder.mkdir(exist_ok=True, mode=0o700)
        (folder / digest).touch(mode=0o600)


def is_built_here(digest: str) -> bool:
    """Return whether Loopwright has built a file with this digest, by a note that only this user can have written."""
    try:
        folder = str(cache_folder())
        built = os.path.join(folder, "built")
        stats = [os.stat(place) for place in (os.path.join(built, digest), built, folder)]
    except (OSError, FmuError):
        return False
    if os.name != "posix":
        return True
    return all(s.st_uid == os.getuid() and not s.st_mode & 0o022 for s in stats)


def check_cache() -> Path:
    """Return the cache folder, after creating it and writing to it."""
    folder = cache_folder()
    with explain_cache_errors():
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)  # the compiler's own cache is there, too
        with tempfile.TemporaryFile(dir=folder):
            pass
    return folder
