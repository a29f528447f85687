"""Temporary folders, which are removed when they are not needed any more, however this process ends."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ...blocks.core import (
    OTHER_TEMPORARY,
    DiskError,
    LoopwrightError,
    describe_disk_error,
    explain_disk_errors,
    find_disk_error,
)
from .keeper import keep_folder, release_folder


def make_folder(place: str | os.PathLike[str] | None = None, prefix: str = "loopwright-") -> Path:
    """Return a fresh folder in ``place``, else among the system's temporary files; `remove_folder` removes it.

    It is removed, too, if this process ends before, however that happens.
    """
    folder = Path(tempfile.mkdtemp(prefix=prefix, dir=place))
    keep_folder(folder)
    return folder


def remove_folder(folder: Path) -> None:
    """Remove a folder of `make_folder` with all that is in it, as far as the system allows."""
    shutil.rmtree(folder, ignore_errors=True)
    release_folder(folder)


@contextmanager
def folder_in(place: str | os.PathLike[str], prefix: str) -> Iterator[Path]:
    """Yield a fresh folder in ``place``, which is removed when the block ends."""
    folder = make_folder(place, prefix)
    try:
        yield folder
    finally:
        remove_folder(folder)


@contextmanager
def temporary_folder(failed: str, raised: type[LoopwrightError] = DiskError, **where: Any) -> Iterator[Path]:
    """Yield a fresh folder among the system's temporary files, which is removed when the block ends.

    Parameters are those of `explain_disk_errors`, which covers the block.
    """
    folder = make_temporary_folder(failed, raised, **where)
    try:
        with explain_disk_errors(failed, folder, OTHER_TEMPORARY, raised, **where):
            yield folder
    finally:
        remove_folder(folder)


def make_temporary_folder(
    failed: str, raised: type[LoopwrightError] = DiskError, prefix: str = "loopwright-", **where: Any
) -> Path:
    """Return a fresh folder among the system's temporary files, as `make_folder` does.

    The other parameters are those of `explain_disk_errors`.
    """
    place = next((value for name in ("TMPDIR", "TEMP", "TMP") if (value := os.environ.get(name))), "/tmp")
    try:
        return make_folder(prefix=prefix)
    except OSError as error:
        # Where no folder can be written, Python lists those that it has tried, and says of none why.
        found = (None if error.filename else find_disk_error(place)) or error
        raise raised(f"{failed}: {describe_disk_error(found, place, OTHER_TEMPORARY)}", **where) from error
