"""Archive of an FMU or an SSP, opened and read with all checks."""

from __future__ import annotations

import hashlib
import io
import os
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from ...blocks.core import FmuFileError, describe_disk_error
from .archive_limits import ArchiveLimits
from .entries import check_entries
from .faults import FmuFault, FmuFinding
from .library_headers import LFS_POINTER
from .parsed_xml import parse_xml

DESCRIPTION = "modelDescription.xml"
BUILD_DESCRIPTION = "sources/buildDescription.xml"
OTHER_PLACE = "Copy it to a folder that you can read."
"""Step where the file can't be read."""
_CHUNK = 1 << 20
_END = struct.Struct("<4s4H2LH")
"""End of the table of contents of a zip archive."""


@dataclass(frozen=True, eq=False)
class FmuArchive:
    """Archive of an FMU, or of an SSP: the table of contents is checked, files are read within the limits.

    The file is read once, so that a file that changes meanwhile can't pass for the one that was checked.
    """

    path: Path
    limits: ArchiveLimits
    files: dict[str, zipfile.ZipInfo]  # by their paths in the archive, with forward slashes; no folders
    findings: tuple[FmuFinding, ...]  # faults that don't keep it from being read
    digest: str  # SHA-256
    size: int  # bytes of the file
    _zip: zipfile.ZipFile = field(repr=False)
    noun: str = "FMU"

    @classmethod
    def open(
        cls, file: str | os.PathLike[str], limits: ArchiveLimits | None = None, *, noun: str = "FMU"
    ) -> FmuArchive:
        """Open an archive and check its table of contents."""
        path, limits = Path(file).expanduser(), limits or ArchiveLimits()
        with _reading(path, noun):
            if not path.is_file():
                found = f"{str(path)!r} is a folder" if path.is_dir() else f"there is no file {str(path)!r}"
                raise FmuFileError(f"{found}; expected an {noun}. Check the path.", fault=FmuFault.NO_FILE)
            if path.stat().st_size > limits.size:
                raise FmuFileError(
                    f"{str(path)!r} has {path.stat().st_size:.3g} bytes; expected at most {limits.size:.3g}. If you "
                    "trust it, raise the limit: limits=ArchiveLimits(size=…).",
                    fault=FmuFault.TOO_LARGE,
                )
            data = path.read_bytes()
            _check_end(path, data, limits, noun)
            content = zipfile.ZipFile(io.BytesIO(data))
            files, findings = check_entries(path, content.infolist(), len(data), limits, noun)
        return cls(path, limits, files, tuple(findings), hashlib.sha256(data).hexdigest(), len(data), content, noun)

    def read(self, name: str, most: int | None = None) -> bytes:
        """Return the content of a file, of so many bytes at ``most``."""
        return b"".join(self.chunks(name, most))

    def chunks(self, name: str, most: int | None = None) -> Iterator[bytes]:
        """Yield the content of a file in parts of about 1 MB; parameters and errors are those of `read`."""
        item = self.files.get(name)
        if item is None:
            raise FmuFileError(
                f"{str(self.path)!r} has no file {name!r}. Export it again.", fault=FmuFault.DAMAGED, subject=name
            )
        if most is not None and item.file_size > most:
            raise FmuFileError(
                f"{name!r} in {str(self.path)!r} has {item.file_size:.3g} bytes; expected at most {most:.3g}. If you "
                "trust it, raise the limit: limits=ArchiveLimits(…).",
                fault=FmuFault.TOO_LARGE,
                subject=name,
            )
        left = item.file_size
        with _reading(self.path, self.noun), self._zip.open(item) as stream:
            while part := stream.read(_CHUNK):
                left -= len(part)
                if left < 0:
                    break
                yield part
            if left:
                raise zipfile.BadZipFile(f"{name} is not as long as the table of contents says")

    def description(self) -> bytes:
        """Return the text of ``modelDescription.xml``."""
        if DESCRIPTION not in self.files:
            nested = next((name for name in self.files if name.endswith(f"/{DESCRIPTION}")), None)
            other = next((name for name in self.files if name.casefold() == DESCRIPTION.casefold()), None)
            hint = f" There is {nested}: pack the files in that folder, not the folder." if nested else ""
            hint = f" There is {other}: its name must be {DESCRIPTION}." if other else hint
            raise FmuFileError(
                f"{str(self.path)!r} is a zip archive without {DESCRIPTION}, so it is no FMU.{hint}",
                fault=FmuFault.NO_DESCRIPTION,
            )
        return self.read(DESCRIPTION, self.limits.description)

    def for_fmpy(self) -> io.BytesIO:
        """Return an archive of the checked descriptions only, so that FMPy sees nothing else."""
        texts = {DESCRIPTION: self.description()}
        if BUILD_DESCRIPTION in self.files:
            texts[BUILD_DESCRIPTION] = self.read(BUILD_DESCRIPTION, self.limits.description)
        only = io.BytesIO()
        with zipfile.ZipFile(only, "w") as archive:
            for name, text in texts.items():
                parse_xml(self.path, name, text)
                archive.writestr(name, text)
        return only


@contextmanager
def _reading(path: Path, noun: str) -> Iterator[None]:
    """Turn every error of reading a zip archive into one of ours."""
    try:
        yield
    except FmuFileError:
        raise
    except MemoryError:
        raise FmuFileError(
            f"{str(path)!r} can't be read: its content does not fit into memory; expected an {noun} of a few MB. Look "
            "at the sizes of the files in it, or export it again.",
            fault=FmuFault.TOO_LARGE,
        ) from None
    except OSError as error:
        raise FmuFileError(
            f"{str(path)!r} can't be read: {describe_disk_error(error, path, OTHER_PLACE)}", fault=FmuFault.DAMAGED
        ) from error
    except Exception as error:  # zipfile raises many kinds of errors on damaged archives
        raise FmuFileError(
            f"{str(path)!r} is no {noun}: it is a damaged zip archive ({str(error) or type(error).__name__}). Copy it "
            "again, or export it again.",
            fault=FmuFault.DAMAGED,
        ) from None


def _check_end(path: Path, data: bytes, limits: ArchiveLimits, noun: str) -> None:
    """Refuse a file without a table of contents, or with one that is far too long to be read."""
    at = data.rfind(b"PK\5\6", max(0, len(data) - 65557))
    if at < 0 or len(data) < at + _END.size:
        found = f"it starts with {data[:8]!r}" if data else "it is empty"
        cut = data.startswith(b"PK\3\4")
        kind = "a zip archive that is cut off: its table of contents is missing" if cut else f"no zip archive ({found})"
        step = "Copy or download it again." if cut else f"Give the .{noun.lower()} that the tool exported."
        if data.startswith(LFS_POINTER):
            kind, step = "a pointer of Git LFS in place of the file", "Get the file with 'git lfs pull'."
        elif data[:200].lstrip()[:9].lower() in (b"<!doctype", b"<html>", b"<html lan"):
            kind, step = "a web page", "Download the file itself, such as by the page's link to the raw file."
        raise FmuFileError(
            f"{str(path)!r} is no {noun}: it is {kind}. {step}", fault=FmuFault.DAMAGED if cut else FmuFault.NO_ARCHIVE
        )
    count, size = _END.unpack_from(data, at)[4:6]
    wide = data.rfind(b"PK\6\6", max(0, at - 10**6), at)
    if 0 <= wide <= len(data) - 48:
        count, size = struct.unpack_from("<2Q", data, wide + 32)
    if count > limits.entries or size > 200 * limits.entries:
        raise FmuFileError(
            f"{str(path)!r} has a table of contents of {size} bytes with {count} files; expected at most "
            f"{limits.entries} files. If you trust it, raise the limit: limits=ArchiveLimits(entries=…).",
            fault=FmuFault.TOO_MANY,
        )
