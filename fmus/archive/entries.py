"""Files in the archive of an FMU or an SSP: their names and sizes, checked before anything is unpacked."""

from __future__ import annotations

import re
import stat
import unicodedata
import zipfile
from collections.abc import Iterable
from pathlib import Path

from ...blocks.core import FmuFileError
from .archive_limits import ArchiveLimits
from .faults import FmuFault, FmuFinding

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
