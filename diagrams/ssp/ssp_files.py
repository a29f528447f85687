"""Files of an SSP: an archive, which is unpacked once, or a description with the files next to it."""

from __future__ import annotations

import os
import posixpath
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from ...blocks.core import FmuFileError, SspFileError, describe_disk_error, near
from ...fmus.archive import ArchiveLimits, FmuArchive, FmuFault, parse_xml, unpack_archive
from ...fmus.platform import cache_folder, explain_cache_errors

DEFAULT = "SystemStructure.ssd"
"""The description that counts where none is named (SSP 1.0, 4.1)."""
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")


@dataclass(frozen=True)
class Package:
    """Files of an SSP, and of a description that is a separate file.

    ``archive``: the archive; None for a description that is a separate file.
    """

    file: Path
    archive: FmuArchive | None
    limits: ArchiveLimits

    @property
    def folder(self) -> Path:
        """Folder of its files; an archive is unpacked for it, once for each content."""
        if self.archive is None:
            return self.file.parent
        folder = cache_folder() / "unpacked" / f"ssp-{self.archive.digest[:32]}"
        with explain_cache_errors():
            is_there = (folder / "resources").exists()
        if not is_there:
            with as_ssp_errors():
                unpack_archive(self.archive, folder)
        return folder

    @property
    def descriptions(self) -> tuple[str, ...]:
        """Names of the descriptions at its root, the default one first."""
        if self.archive is None:
            return (self.file.name,)
        found = [name for name in self.archive.files if "/" not in name and name.endswith(".ssd")]
        return tuple(sorted(found, key=lambda name: (name != DEFAULT, name)))

    def read(self, name: str, subject: str) -> bytes:
        """Return the content of a small file.

        Raises `SspFileError` if it is missing, damaged or too large.
        """
        if self.archive is not None:
            if name not in self.archive.files:
                raise self._missing(name, subject, self.archive.files)
            with as_ssp_errors():
                return self.archive.read(name, self.limits.description)
        path = self.folder / name
        try:
            if path.is_file() and path.stat().st_size > self.limits.description:
                raise SspFileError(
                    f"{str(path)!r} has {path.stat().st_size:.3g} bytes; expected at most "
                    f"{self.limits.description:.3g}. If you trust it, raise the limit: limits=ArchiveLimits(…).",
                    fault=FmuFault.TOO_LARGE,
                    subject=name,
                )
            return path.read_bytes()
        except FileNotFoundError:
            raise self._missing(name, subject, ()) from None
        except OSError as error:
            found = describe_disk_error(error, path, "Copy it to a folder that you can read.")
            raise SspFileError(f"{str(path)!r} can't be read: {found}", fault=FmuFault.DAMAGED) from error

    def path(self, name: str, subject: str) -> Path:
        """Return the place of a file on the disk; parameters and errors are those of `read`."""
        if self.archive is not None and name not in self.archive.files:
            raise self._missing(name, subject, self.archive.files)
        path = self.folder / name
        if not path.is_file():
            raise self._missing(name, subject, ())
        return path

    def _missing(self, name: str, subject: str, known: Any) -> SspFileError:
        hint = f" {near(name, known)}" if known else ""
        return SspFileError(
            f"{subject} of {str(self.file)!r} refers to the file {name!r}, which is not there; expected it in the same "
            f"package.{hint} Export it again, with this file.",
            fault=FmuFault.NO_FILE,
            subject=name,
        )


@dataclass(frozen=True)
class PackagedFile:
    """File in a package, against which the URIs in it are resolved."""

    package: Package
    name: str
    """Its path from the root of the package."""

    def resolve(self, uri: str, subject: str) -> PackagedFile:
        """Return the file that a relative URI names.

        Raises `SspFileError`: for a URI with a scheme, an absolute one, and one that points out of an archive.
        """
        scheme = _SCHEME.match(uri)
        if scheme or uri.startswith("/"):
            found = f"the URI {uri!r}, with the scheme {scheme[0]!r}" if scheme else f"the absolute URI {uri!r}"
            raise SspFileError(
                f"{subject} of {str(self.package.file)!r} refers to {found}; expected a path in the package, such as "
                "'resources/plant.fmu'. Put the file into the package.",
                fault=FmuFault.UNSAFE_PATH,
                subject=uri,
            )
        name = posixpath.normpath(posixpath.join(posixpath.dirname(self.name), unquote(uri)))
        if "\\" in name or (name.startswith("..") and self.package.archive is not None):
            raise SspFileError(
                f"{subject} of {str(self.package.file)!r} refers to {uri!r}, which points out of the package; expected "
                "a path in it. Put the file into the package.",
                fault=FmuFault.UNSAFE_PATH,
                subject=uri,
            )
        return replace(self, name=name)

    def read(self, subject: str) -> bytes:
        """Return the file's content; errors are those of `Package.read`."""
        return self.package.read(self.name, subject)

    def path(self, subject: str) -> Path:
        """Return the file's place on the disk; errors are those of `Package.read`."""
        return self.package.path(self.name, subject)

    def parse(self, subject: str) -> Any:
        """Return the root element of the file's XML; errors are those of `Package.read`, and those of bad XML."""
        text = self.read(subject)
        with as_ssp_errors():
            return parse_xml(self.package.file, self.name, text, "SSP")


def open_package(file: str | os.PathLike[str], limits: ArchiveLimits | None = None) -> Package:
    """Open an SSP, or a description that is a separate file, or its folder.

    Raises `SspFileError` if the file is missing, or its archive is unsafe, damaged or beyond the limits, as of an FMU.
    """
    path, limits = Path(file).expanduser(), limits or ArchiveLimits()
    if path.is_dir() and (path / DEFAULT).is_file():
        path = path / DEFAULT
    if path.suffix.lower() == ".ssd" and path.is_file():
        return Package(path.absolute(), None, limits)
    with as_ssp_errors():
        return Package(path, FmuArchive.open(path, limits, noun="SSP"), limits)


@contextmanager
def as_ssp_errors() -> Iterator[None]:
    """Raise the errors of the guard of archives as those of an SSP."""
    try:
        yield
    except SspFileError:
        raise
    except FmuFileError as error:
        raise SspFileError(error.message, fault=error.fault, subject=error.subject) from error.__cause__
