"""Unpacking of an FMU or an SSP into the cache, once for each content."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

from ...blocks.core import FmuFileError
from ..child_processes import folder_in
from ..platform import cache_folder, check_cache, explain_cache_errors
from .binaries import check_binary
from .description import FmuDescription
from .faults import FmuFault
from .zip_file import FmuArchive

RESOURCES = "resources"
"""Folder whose place an FMU gets when it is instantiated (FMI 2.0, 2.1.5; FMI 3.0, 2.3.1): it is there, empty or not.
"""


def unpack(description: FmuDescription) -> Path:
    """Unpack an FMU, once for each content, and return the folder of its files."""
    folder, resources = _place_of(cache_folder(), description.digest)
    if os.path.exists(resources):
        return folder
    with explain_cache_errors():
        if resources.exists():  # an error for whoever may not look
            return folder
    archive = FmuArchive.open(description.file, description.limits)
    if archive.digest != description.digest:
        raise FmuFileError(
            f"{str(description.file)!r} has changed since its description was read; expected the file of before. Make "
            "the block again, Fmu(…), to take the new one.",
            fault=FmuFault.DAMAGED,
        )
    check_binary(archive, description.binary, description.fmi, model_exchange=not description.co_simulation)
    unpack_archive(archive, folder)
    return folder


@lru_cache(maxsize=64)
def _place_of(cache: Path, digest: str) -> tuple[Path, Path]:
    """Return the folder of an unpacked FMU, and its resources."""
    folder = cache / "unpacked" / digest[:32]
    return folder, folder / RESOURCES


def unpack_archive(archive: FmuArchive, folder: Path) -> None:
    """Unpack a checked archive into a folder, which appears whole or not at all."""
    check_cache()
    with explain_cache_errors(f"the {archive.noun} {str(archive.path)!r} can't be unpacked"):
        folder.parent.mkdir(parents=True, exist_ok=True)
        with folder_in(folder.parent, "tmp") as fresh:
            write_files(archive, fresh)
            with suppress(FileExistsError):
                (fresh / RESOURCES).mkdir()
            try:
                fresh.rename(folder)
            except OSError:  # another process was faster, or an earlier version has left the empty folder out
                if not folder.is_dir():
                    raise
                with suppress(FileExistsError):
                    (folder / RESOURCES).mkdir()


def write_files(archive: FmuArchive, folder: Path, names: Iterable[str] | None = None) -> None:
    """Write files of a checked archive, all of them without names, into an empty folder, and nothing outside of it."""
    root = folder.resolve()
    for name in archive.files if names is None else names:
        target = root.joinpath(*name.split("/"))
        if not target.resolve().is_relative_to(root):  # the names were checked; this holds on any system
            raise FmuFileError(
                f"{str(archive.path)!r} holds a file {name!r}, which points out of the {archive.noun}'s folder. Don't "
                "unpack it.",
                fault=FmuFault.UNSAFE_PATH,
                subject=name,
            )
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("xb") as stream:
            for part in archive.chunks(name):
                stream.write(part)
