"""Archive of an FMU or an SSP: names and sizes of its files are checked before anything is read or unpacked."""

from __future__ import annotations

import hashlib
import io
import os
import re
import stat
import struct
import unicodedata
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from ...blocks.core import FmuFileError, describe_disk_error
from .archive_limits import ArchiveLimits
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
            is_ssp = "SystemStructure.ssd" in self.files
            hint = " It is an SSP: Diagram.from_ssp reads it." if is_ssp else " Give the .fmu that the tool exported."
            hint = f" There is {nested}: pack the files in that folder, not the folder." if nested else hint
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


# --- check of the entries ---------------------------------------------------------------------------------------------


_DRIVE = re.compile(r"[A-Za-z]:")
_CONTROL = re.compile(r"[\x00-\x1f\x7f]")
_LONGEST_NAME = 255  # bytes of a file's name, on the usual file systems
_LONGEST_PATH = 2000  # bytes of a path, so that the folder above it fits into 4096
_SMALL = 10**8  # bytes: a smaller archive may be packed by any ratio
_HEADER = 30  # bytes before each file in the archive
_METHODS = {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA}
_AGAIN = "Export it again, or ask its maker; don't unpack it with other programs."


def check_entries(
    path: Path, items: Iterable[zipfile.ZipInfo], packed: int, limits: ArchiveLimits, noun: str = "FMU"
) -> tuple[dict[str, zipfile.ZipInfo], list[FmuFinding]]:
    """Return an archive's files by their paths with forward slashes, and findings about them.

    ``packed`` is the size of the archive in bytes.
    """
    items = list(items)
    if len(items) > limits.entries:
        raise FmuFileError(
            f"{str(path)!r} holds {len(items)} files; expected at most {limits.entries}. {_raise_limit('entries')}",
            fault=FmuFault.TOO_MANY,
        )
    _check_sizes(path, items, packed, limits)
    found: dict[str, zipfile.ZipInfo] = {}
    findings: list[FmuFinding] = []
    backslashes: list[str] = []
    for item in items:
        name = _check_name(path, item.orig_filename, noun)
        if "\\" in item.orig_filename:
            backslashes.append(item.orig_filename)
        _check_kind(path, name, item)
        if not name or item.orig_filename[-1] in "/\\":
            continue
        if name in found:
            findings.append(_duplicate(path, name, found[name], item))
        else:
            found[name] = item
    if backslashes:
        findings.append(
            FmuFinding(
                FmuFault.BACKSLASH,
                backslashes[0],
                f"{len(backslashes)} of {len(items)} paths in the archive have backslashes, such as "
                f"{backslashes[0]!r}; expected slashes. They are taken for slashes here; other tools refuse the "
                f"{noun} or write files with wrong names.",
                "Report it to its maker, or pack it again.",
            )
        )
    findings += _compare_case(path, found)
    return found, findings


def _raise_limit(name: str) -> str:
    return f"If you trust it, raise the limit: limits=ArchiveLimits({name}=…)."


def _check_sizes(path: Path, items: list[zipfile.ZipInfo], packed: int, limits: ArchiveLimits) -> None:
    total = sum(item.file_size for item in items)
    if total > limits.size:
        largest = max(items, key=lambda item: item.file_size)
        raise FmuFileError(
            f"{str(path)!r} unpacks to {total:.3g} bytes (its largest file is {largest.orig_filename!r}); expected at "
            f"most {limits.size:.3g}. {_raise_limit('size')}",
            fault=FmuFault.TOO_LARGE,
            subject=largest.orig_filename,
        )
    if total > _SMALL and total > limits.ratio * packed:
        worst = max(items, key=lambda item: item.file_size / (item.compress_size + _HEADER))
        raise FmuFileError(
            f"{str(path)!r} unpacks to {total / packed:.3g} times its size, {total:.3g} bytes (the worst is "
            f"{worst.orig_filename!r}); expected at most {limits.ratio:g} times. It may be made to fill the disk. "
            f"{_raise_limit('ratio')}",
            fault=FmuFault.RATIO,
            subject=worst.orig_filename,
        )
    inside = sum(item.compress_size + _HEADER for item in items)
    if inside > packed:
        raise FmuFileError(
            f"the files in {str(path)!r} overlap: they take {inside} bytes of its {packed}. It is damaged or made to "
            f"fill the disk. {_AGAIN}",
            fault=FmuFault.OVERLAP,
        )


def _check_name(path: Path, given: str, noun: str) -> str:
    """Return the path of a file in the archive with forward slashes, without empty parts and dots."""
    name = given.replace("\\", "/")
    parts = [part for part in name.split("/") if part not in ("", ".")]
    if name.startswith("/") or _DRIVE.match(name) or ".." in parts:
        raise FmuFileError(
            f"{str(path)!r} holds a file {given!r}, which points out of the {noun}'s folder; expected a path within "
            f"it. It may be made to overwrite your files. {_AGAIN}",
            fault=FmuFault.UNSAFE_PATH,
            subject=given,
        )
    long = any(len(part.encode(errors="replace")) > _LONGEST_NAME for part in parts)
    if _CONTROL.search(name) or long or len(name.encode(errors="replace")) > _LONGEST_PATH:
        shown = given if len(given) < 80 else f"{given[:77]}…"
        raise FmuFileError(
            f"{str(path)!r} holds a file {shown!r}; expected a name without control characters, of at most "
            f"{_LONGEST_NAME} bytes, in a path of at most {_LONGEST_PATH}. {_AGAIN}",
            fault=FmuFault.UNSAFE_PATH,
            subject=given,
        )
    return "/".join(parts)


def _check_kind(path: Path, name: str, item: zipfile.ZipInfo) -> None:
    mode = stat.S_IFMT(item.external_attr >> 16)
    if mode not in (0, stat.S_IFREG, stat.S_IFDIR):
        kind = "a link" if mode == stat.S_IFLNK else "a special file"
        raise FmuFileError(
            f"{str(path)!r} holds {kind}, {name!r}; expected files and folders. Pack the file itself in its place.",
            fault=FmuFault.LINK,
            subject=name,
        )
    if item.flag_bits & 0x1:
        raise FmuFileError(
            f"{str(path)!r} can't be read: {name!r} is encrypted. Pack it again without a password.",
            fault=FmuFault.ENCRYPTED,
            subject=name,
        )
    if item.compress_type not in _METHODS:
        raise FmuFileError(
            f"{str(path)!r} can't be read: {name!r} is packed by the compression method {item.compress_type}, which "
            "is not known here. Pack it again by the usual compression (deflate).",
            fault=FmuFault.COMPRESSION,
            subject=name,
        )


def _duplicate(path: Path, name: str, first: zipfile.ZipInfo, second: zipfile.ZipInfo) -> FmuFinding:
    """Return a finding on two files of one name and content."""
    if (first.CRC, first.file_size) != (second.CRC, second.file_size):
        raise FmuFileError(
            f"{str(path)!r} holds two different files {name!r}; expected one. Programs differ in which one they take. "
            f"{_AGAIN}",
            fault=FmuFault.DUPLICATE_FILE,
            subject=name,
        )
    return FmuFinding(
        FmuFault.DUPLICATE_FILE, name, f"the archive holds {name!r} twice, with one content.", "Pack it again."
    )


def _compare_case(path: Path, files: dict[str, zipfile.ZipInfo]) -> list[FmuFinding]:
    """Return findings on names that are one name on some systems, and refuse files of different content."""
    findings, seen, folders = [], dict[str, str](), dict[str, str]()
    for name in files:
        key = unicodedata.normalize("NFC", name).casefold()
        other = seen.setdefault(key, name)
        if other != name:
            if (files[other].CRC, files[other].file_size) != (files[name].CRC, files[name].file_size):
                raise FmuFileError(
                    f"{str(path)!r} holds two different files {other!r} and {name!r}, which are one file on Windows "
                    f"and macOS; expected names that differ in more than case. {_AGAIN}",
                    fault=FmuFault.CASE,
                    subject=name,
                )
            text = f"the archive holds {other!r} and {name!r}, which differ in case only and have one content."
            findings.append(FmuFinding(FmuFault.CASE, name, text, "Leave one of them out."))
        parts = key.split("/")
        folders.update({"/".join(parts[:i]): name for i in range(1, len(parts))})
    for key, name in seen.items():
        if key in folders:
            raise FmuFileError(
                f"{str(path)!r} holds {name!r} as a file and as a folder, of {folders[key]!r}; expected one of them. "
                f"{_AGAIN}",
                fault=FmuFault.DUPLICATE_FILE,
                subject=name,
            )
    return findings
