"""Headers of shared libraries, read without loading them.

ELF is read as far as a loader does: a file that ends before its segments do would take the whole process down with
SIGBUS (System V ABI, chapters 4 and 5). PE and Mach-O are read for their machines, and held against the file's size.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

_MACHINES = {
    "linux": {0x03: "x86", 0x3E: "x86_64", 0x28: "aarch32", 0xB7: "aarch64", 0xF3: "riscv64"},
    "windows": {0x14C: "x86", 0x8664: "x86_64", 0xAA64: "aarch64"},
    "darwin": {0x7: "x86", 0x1000007: "x86_64", 0x100000C: "aarch64"},
}
LFS_POINTER = b"version https://git-lfs"
"""Beginning of the small text that replaces a file in a repository with Git LFS."""
_LOADED, _DYNAMIC = 1, 2
_NEEDED, _HASH, _STRTAB, _SYMTAB, _STRSZ, _GNU_HASH = 1, 4, 5, 6, 10, 0x6FFFFEF5
_SHARED = 3


@dataclass(frozen=True)
class SharedLibrary:
    """Header of a shared library."""

    platforms: tuple[str, ...] = ()  # as FMI 3.0 names them (2.5.1.4); none for an unknown format
    damage: str = ""  # reason why it can't be loaded safely
    needed: tuple[str, ...] = ()  # shared libraries, of ELF only
    symbols: frozenset[str] | None = None  # exported; None if they are not known, as for PE and Mach-O
    undefined: frozenset[str] = frozenset()  # for other libraries to define, weak ones left out; of ELF only


def read_library(data: bytes) -> SharedLibrary:
    """Read the header of a shared library from its content."""
    if not data:
        return SharedLibrary(damage="it is empty")
    try:
        platforms = _find_platforms(data)
    except (struct.error, IndexError):
        return SharedLibrary(damage=f"it is cut off within its header, after {len(data)} bytes")
    if data.startswith(LFS_POINTER):
        return SharedLibrary(damage="it is a pointer of Git LFS in place of the library; 'git lfs pull' gets it")
    if platforms is None:
        return SharedLibrary(damage=f"it is no shared library: it starts with {data[:8]!r}")
    check = {b"\x7fE": _read_elf, b"MZ": _read_pe, b"\xca\xfe": _read_universal}.get(data[:2])
    try:
        return SharedLibrary(platforms) if check is None else check(data, platforms)
    except (struct.error, IndexError):
        return SharedLibrary(platforms, f"it is cut off within its header, after {len(data)} bytes")


def _find_platforms(data: bytes) -> tuple[str, ...] | None:
    """Return the platforms that a header names; None for an unknown format."""
    if data[:4] == b"\x7fELF":
        return _platforms("linux", struct.unpack_from("<H" if data[5] == 1 else ">H", data, 18)[0])
    if data[:2] == b"MZ":
        (start,) = struct.unpack_from("<I", data, 0x3C)
        return _platforms("windows", struct.unpack_from("<4xH", data, start)[0] if _is_pe(data, start) else 0)
    if data[:4] in (b"\xcf\xfa\xed\xfe", b"\xce\xfa\xed\xfe"):
        return _platforms("darwin", struct.unpack_from("<I", data, 4)[0])
    if data[:4] == b"\xca\xfe\xba\xbe":  # several architectures in one file
        return _platforms("darwin", *(row[0] for row in _rows(data)))
    return None


def _is_pe(data: bytes, start: int) -> bool:
    return data[start : start + 4] == b"PE\0\0"


def _rows(data: bytes) -> list[tuple[int, ...]]:
    """Return architecture, offset and size (at 0, 2, 3) of the parts of a universal file of macOS."""
    (count,) = struct.unpack_from(">I", data, 4)
    return [struct.unpack_from(">5I", data, 8 + 20 * i) for i in range(count)] if count < 16 else []


def _platforms(system: str, *machines: int) -> tuple[str, ...]:
    known = _MACHINES[system]
    return tuple(dict.fromkeys(f"{known[m]}-{system}" for m in machines if m in known))


def _cut(end: int, data: bytes) -> str:
    return f"it is cut off: it has {len(data)} bytes; expected at least {end}"


# --- ELF ------------------------------------------------------------------------------------------------------------


def _read_elf(data: bytes, platforms: tuple[str, ...]) -> SharedLibrary:
    wide, order = data[4] == 2, "<" if data[5] == 1 else ">"
    (kind,) = struct.unpack_from(f"{order}H", data, 16)
    if kind != _SHARED:
        return SharedLibrary(platforms, f"it is no shared library, but another kind of ELF file (type {kind})")
    table, entry, count = (
        (*struct.unpack_from(f"{order}Q", data, 32), *struct.unpack_from(f"{order}HH", data, 54))
        if wide
        else (*struct.unpack_from(f"{order}I", data, 28), *struct.unpack_from(f"{order}HH", data, 42))
    )
    if table + entry * count > len(data):
        return SharedLibrary(platforms, _cut(table + entry * count, data))
    segments = []
    for i in range(count):
        at = table + entry * i
        if wide:
            kind, _, offset, address, _, size, _ = struct.unpack_from(f"{order}II5Q", data, at)
        else:
            kind, offset, address, _, size, _ = struct.unpack_from(f"{order}6I", data, at)
        if kind in (_LOADED, _DYNAMIC):
            segments.append((kind, offset, address, size))
    end = max((offset + size for _, offset, _, size in segments), default=0)
    if end > len(data):
        return SharedLibrary(platforms, _cut(end, data))
    if not any(kind == _LOADED for kind, *_ in segments):
        return SharedLibrary(platforms, "it is no shared library: no part of it is to be loaded")
    try:
        return _read_dynamic(data, wide, order, segments, platforms)
    except (struct.error, IndexError, StopIteration, ValueError):
        return SharedLibrary(platforms, "its tables of symbols and of needed libraries point out of the file")


def _read_dynamic(
    data: bytes, wide: bool, order: str, segments: list[tuple[int, int, int, int]], platforms: tuple[str, ...]
) -> SharedLibrary:
    """Read the needed libraries and symbols, from where the loader does; sections may be stripped."""
    start, size = next((offset, size) for kind, offset, _, size in segments if kind == _DYNAMIC)
    pair = struct.Struct(f"{order}2Q" if wide else f"{order}2I")
    entries: list[tuple[int, int]] = []
    for tag, value in pair.iter_unpack(data[start : start + size - size % pair.size]):
        if tag == 0:
            break
        entries.append((tag, value))
    found = dict(entries)

    def place(address: int) -> int:
        return next(o + address - a for kind, o, a, n in segments if kind == _LOADED and a <= address < a + n)

    texts = place(found[_STRTAB]) if _STRTAB in found else 0
    end = min(texts + found.get(_STRSZ, 0), len(data))

    def text(offset: int) -> str:
        stop = data.index(b"\0", texts + offset, end)
        return data[texts + offset : stop].decode(errors="replace")

    needed = tuple(text(value) for tag, value in entries if tag == _NEEDED)
    symbols, undefined = set[str](), set[str]()
    if _SYMTAB in found:
        count = _count_symbols(data, wide, order, found, place)
        for name, defined, weak in _symbols(data, wide, order, place(found[_SYMTAB]), count):
            if name and defined:
                symbols.add(text(name))
            elif name and not weak:
                undefined.add(text(name))
    return SharedLibrary(platforms, "", needed, frozenset(symbols), frozenset(undefined))


def _symbols(data: bytes, wide: bool, order: str, start: int, count: int) -> Iterator[tuple[int, bool, bool]]:
    """Yield the place of the name of each symbol, whether it is defined here for others, and whether it is weak."""
    row = struct.Struct(f"{order}IBBHQQ" if wide else f"{order}IIIBBH")
    if start + count * row.size > len(data):
        raise ValueError
    for fields in row.iter_unpack(data[start : start + count * row.size]):
        name, info, other, section = (fields[0], *fields[1:4]) if wide else (fields[0], *fields[3:6])
        bind = info >> 4
        yield name, section != 0 and bind != 0 and other & 3 in (0, 3), bind == 2


def _count_symbols(data: bytes, wide: bool, order: str, found: dict[int, int], place: Any) -> int:
    """Return the number of symbols, which only the hash tables tell."""
    if _HASH in found:
        return int(struct.unpack_from(f"{order}2I", data, place(found[_HASH]))[1])
    if _GNU_HASH not in found:
        return 0
    at = place(found[_GNU_HASH])
    buckets, first, bloom, _ = struct.unpack_from(f"{order}4I", data, at)
    at += 16 + bloom * (8 if wide else 4)
    if at + 4 * buckets > len(data):
        raise ValueError
    last = max(struct.unpack_from(f"{order}{buckets}I", data, at), default=0)
    if last < first:
        return int(first)
    at += 4 * buckets
    while not struct.unpack_from(f"{order}I", data, at + 4 * (last - first))[0] & 1:
        last += 1
    return int(last) + 1


# --- PE and Mach-O --------------------------------------------------------------------------------------------------


def _read_pe(data: bytes, platforms: tuple[str, ...]) -> SharedLibrary:
    (start,) = struct.unpack_from("<I", data, 0x3C)
    if not _is_pe(data, start):
        damage = _cut(start + 4, data) if start + 4 > len(data) else "it is no Windows library: it has no PE header"
        return SharedLibrary(platforms, damage)
    count, optional = struct.unpack_from("<2xH12xH", data, start + 4)
    end = 0
    for i in range(count):
        size, offset = struct.unpack_from("<II", data, start + 24 + optional + 40 * i + 16)
        end = max(end, offset + size if size else 0)
    return SharedLibrary(platforms, _cut(end, data) if end > len(data) else "")


def _read_universal(data: bytes, platforms: tuple[str, ...]) -> SharedLibrary:
    rows = _rows(data)
    if not rows:
        return SharedLibrary(platforms, "it is no library of macOS: it has no architectures, or too many")
    end = max(row[2] + row[3] for row in rows)
    return SharedLibrary(platforms, _cut(end, data) if end > len(data) else "")
