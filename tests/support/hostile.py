"""Hostile and broken FMU files, made from a good one: mangled archives, descriptions and libraries.

Each case is a function from the files of a good FMU (names and bytes) to the bytes of a bad one, with the fault that it
must be told by; None where it must be accepted. All are written by hand here, with the zip format's own numbers where
`zipfile` refuses to write them.
"""

import io
import re
import stat
import struct
import zipfile
from dataclasses import dataclass, field

from loopwright.fmus import ArchiveLimits
from loopwright.types import FmuFault

XML = "modelDescription.xml"


@dataclass(frozen=True)
class Case:
    make: object
    """Takes a dictionary of the good FMU's files and returns the bad one's bytes."""
    fault: FmuFault | None
    """Kind of the error; None if it is accepted."""
    finding: FmuFault | None = None
    """Kind of a finding about the archive, where it is accepted."""
    limits: ArchiveLimits = field(default_factory=ArchiveLimits)


def packed(files, *more, method=zipfile.ZIP_DEFLATED):
    """Return an archive; further pairs may repeat names, and have a ZipInfo in place of a name."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        for name, data in (*files.items(), *more):
            archive.NameToInfo.clear()  # it warns of names that are there already
            archive.writestr(name, data)
    return stream.getvalue()


def patched(data, name, *, central, local, form, value, every=False):
    """Write a number into both headers of a file in an archive (APPNOTE 4.3.7 and 4.3.12)."""
    data = bytearray(data)
    for magic, offset, length in ((b"PK\1\2", central, 46), (b"PK\3\4", local, 30)):
        at = -1
        while (at := data.find(magic, at + 1)) >= 0:
            if offset is not None and (every or data[at + length : at + length + len(name)] == name.encode()):
                struct.pack_into(form, data, at + offset, value)
    return bytes(data)


def adding(*pairs):
    return lambda files: packed(files, *pairs)


def special(name, kind, data=b""):
    item = zipfile.ZipInfo(name)
    item.external_attr = (kind | 0o777) << 16
    item.create_system = 3
    return item, data


def backslashes(files):
    """Return an archive as some tools for Windows write it; `zipfile` keeps backslashes on other systems."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, data in files.items():
            item = zipfile.ZipInfo(name)
            item.filename = item.orig_filename = name.replace("/", "\\")
            archive.writestr(item, data)
    return stream.getvalue()


def control(files):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
        item = zipfile.ZipInfo("x")
        item.filename = item.orig_filename = "resources/a\nb"
        archive.writestr(item, b"")
    return stream.getvalue()


def overlapping(files):
    """Return an archive whose table of contents names one file's bytes a thousand times (as zip bombs do)."""
    data = packed(files, ("resources/zeros", bytes(50_000)), method=zipfile.ZIP_STORED)
    end = data.rindex(b"PK\5\6")
    start, length = struct.unpack_from("<I", data, end + 16)[0], struct.unpack_from("<I", data, end + 12)[0]
    entry = data.index(b"PK\1\2", data.index(b"resources/zeros", start) - 46)
    row = data[entry : entry + 46 + len("resources/zeros")]
    rows = b"".join(row.replace(b"resources/zeros", b"resources/%05d" % k) for k in range(1000))
    tail = bytearray(data[end:])
    count = struct.unpack_from("<H", tail, 8)[0] + 1000
    struct.pack_into("<HH", tail, 8, count, count)
    struct.pack_into("<I", tail, 12, length + len(rows))
    return data[:end] + rows + bytes(tail)


def damaged(name):
    def make(files):
        data = bytearray(packed(files))
        at = data.index(name.encode()) + len(name) + 20
        data[at : at + 20] = bytes(b ^ 0xFF for b in data[at : at + 20])
        return bytes(data)

    return make


def shorter(files):
    """Return an archive whose table of contents claims a smaller description than there is."""
    return patched(packed(files), XML, central=24, local=22, form="<I", value=100)


def described(*changes):
    """Return a maker that replaces patterns in the description; each must be there."""

    def make(files):
        text = files[XML].decode()
        for old, new in changes:
            text, n = re.subn(old, lambda match, new=new: match.expand(new), text, count=1)
            assert n, old
        return packed({**files, XML: text.encode()})

    return make


def text(data):
    return lambda files: packed({**files, XML: data})


def entity(definition, use="&x;"):
    def make(files):
        body = files[XML].decode().split("?>", 1)[1]
        body = re.sub(r'modelName="[^"]*"', f'modelName="{use}"', body, count=1)
        return packed(
            {**files, XML: f'<?xml version="1.0"?>\n<!DOCTYPE fmiModelDescription {definition}>{body}'.encode()}
        )

    return make


LAUGHS = "".join(
    f'<!ENTITY l{k} "{f"&l{k - 1};" * 10 if k else "ha"}">' for k in range(12)
)  # a text of 10**11 letters, if it is expanded


def library(change):
    """Return a maker that changes the bytes of the libraries for Linux."""
    return lambda files: packed(
        {name: change(data) if name.startswith("binaries/") else data for name, data in files.items()}
    )


def without_library(files):
    return {name: data for name, data in files.items() if not name.startswith("binaries/")}


def binaries(files):
    return [name for name in files if name.startswith("binaries/")]


def other_name(*names):
    def make(files):
        (old,) = binaries(files)
        folder = old.rpartition("/")[0]
        return packed(without_library(files), *((f"{folder}/{name}", files[old]) for name in names))

    return make


def machine(number):
    def change(data):
        data = bytearray(data)
        struct.pack_into("<H", data, 18, number)
        return bytes(data)

    return change


ARCHIVES = {
    "empty": Case(lambda files: b"", FmuFault.NO_ARCHIVE),
    "a web page": Case(lambda files: b"<!DOCTYPE html><html>404 Not Found</html>" * 99, FmuFault.NO_ARCHIVE),
    "a pointer of Git LFS": Case(
        lambda files: b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", FmuFault.NO_ARCHIVE
    ),
    "a gzip file": Case(lambda files: b"\x1f\x8b\x08" + bytes(1000), FmuFault.NO_ARCHIVE),
    "cut off": Case(lambda files: packed(files)[:-200], FmuFault.DAMAGED),
    "cut off in the middle": Case(lambda files: packed(files)[:3000], FmuFault.DAMAGED),
    "without its beginning": Case(lambda files: packed(files)[1000:], FmuFault.DAMAGED),
    "path upwards": Case(adding(("../../escaped.txt", b"x")), FmuFault.UNSAFE_PATH),
    "path upwards within": Case(adding(("resources/../../escaped.txt", b"x")), FmuFault.UNSAFE_PATH),
    "path upwards with backslashes": Case(adding(("..\\..\\escaped.txt", b"x")), FmuFault.UNSAFE_PATH),
    "absolute path": Case(adding(("/tmp/escaped.txt", b"x")), FmuFault.UNSAFE_PATH),
    "drive": Case(adding(("C:\\escaped.txt", b"x")), FmuFault.UNSAFE_PATH),
    "network path": Case(adding(("\\\\server\\escaped.txt", b"x")), FmuFault.UNSAFE_PATH),
    "control character": Case(control, FmuFault.UNSAFE_PATH),
    "long name": Case(adding(("resources/" + 300 * "n", b"x")), FmuFault.UNSAFE_PATH),
    "long path": Case(adding((300 * "folder/" + "x", b"x")), FmuFault.UNSAFE_PATH),
    "backslashes": Case(backslashes, None, FmuFault.BACKSLASH),
    "link out": Case(adding(special("resources/link", stat.S_IFLNK, b"../../..")), FmuFault.LINK),
    "link and a file in it": Case(
        adding(special("resources/link", stat.S_IFLNK, b"/tmp"), ("resources/link/escaped.txt", b"x")), FmuFault.LINK
    ),
    "device": Case(adding(special("resources/device", stat.S_IFCHR)), FmuFault.LINK),
    "large": Case(
        adding(("resources/a", bytes(9000)), ("resources/b", bytes(2**20))),
        FmuFault.TOO_LARGE,
        limits=ArchiveLimits(size=10**6),
    ),
    "large file": Case(lambda files: packed(files), FmuFault.TOO_LARGE, limits=ArchiveLimits(size=1000)),
    "bomb": Case(adding(("resources/zeros", bytes(120_000_000))), FmuFault.RATIO),
    "many files": Case(
        adding(*((f"resources/{k}", b"") for k in range(99))), FmuFault.TOO_MANY, limits=ArchiveLimits(entries=50)
    ),
    "overlapping files": Case(overlapping, FmuFault.OVERLAP),
    "encrypted": Case(
        lambda files: patched(packed(files), XML, central=8, local=6, form="<H", value=1), FmuFault.ENCRYPTED
    ),
    "unknown compression": Case(
        lambda files: patched(packed(files), XML, central=10, local=8, form="<H", value=99), FmuFault.COMPRESSION
    ),
    "another size": Case(shorter, FmuFault.DAMAGED),
    "less than it says": Case(
        lambda files: patched(packed(files), XML, central=24, local=22, form="<I", value=len(files[XML]) + 1000),
        FmuFault.DAMAGED,
    ),
    "another checksum": Case(
        lambda files: patched(packed(files), XML, central=16, local=14, form="<I", value=7), FmuFault.DAMAGED
    ),
    "damaged description": Case(damaged(XML), FmuFault.DAMAGED),
    "one file twice": Case(lambda files: packed(files, (XML, files[XML])), None, FmuFault.DUPLICATE_FILE),
    "two files of one name": Case(lambda files: packed(files, (XML, files[XML] + b" ")), FmuFault.DUPLICATE_FILE),
    "two files by slashes": Case(lambda files: packed(files, (f"./{XML}", files[XML] + b" ")), FmuFault.DUPLICATE_FILE),
    "names that differ in case": Case(adding(("resources/A", b"x"), ("resources/a", b"y")), FmuFault.CASE),
    "one content in two cases": Case(adding(("resources/A", b"x"), ("resources/a", b"x")), None, FmuFault.CASE),
    "a file as a folder": Case(adding(("resources/a", b"x"), ("resources/a/b", b"y")), FmuFault.DUPLICATE_FILE),
    "in a folder": Case(lambda files: packed({f"plant/{n}": d for n, d in files.items()}), FmuFault.NO_DESCRIPTION),
    "in lower case": Case(
        lambda files: packed({n.lower() if n == XML else n: d for n, d in files.items()}), FmuFault.NO_DESCRIPTION
    ),
}

DESCRIPTIONS = {
    "no XML": Case(text(b"no XML"), FmuFault.XML),
    "nothing": Case(text(b""), FmuFault.XML),
    "cut off": Case(lambda files: text(files[XML][:2000])(files), FmuFault.XML),
    "a web page": Case(text(b"<html><body/></html>"), FmuFault.DESCRIPTION),
    "deep": Case(text(b"<a>" * 10**5 + b"</a>" * 10**5), FmuFault.XML),
    "entities in entities": Case(entity(f"[{LAUGHS}]", "&l11;"), FmuFault.ENTITY),
    "a large entity": Case(entity(f'[<!ENTITY x "{"a" * 10**5}">]', "&x;" * 10**4), FmuFault.ENTITY),
    "an entity": Case(entity('[<!ENTITY x "plant">]'), FmuFault.ENTITY),
    "a parameter entity": Case(entity('[<!ENTITY % x SYSTEM "file:///etc/passwd"> %x;]', "plant"), FmuFault.ENTITY),
    "a file as an entity": Case(entity('[<!ENTITY x SYSTEM "file:///etc/passwd">]', "plant"), FmuFault.ENTITY),
    "another file's rules": Case(entity('SYSTEM "http://127.0.0.1:9/rules.dtd"', "plant"), FmuFault.ENTITY),
    "too long": Case(lambda files: packed(files), FmuFault.TOO_LARGE, limits=ArchiveLimits(description=1000)),
    "no version": Case(described((r' fmiVersion="[^"]*"', "")), FmuFault.DESCRIPTION),
    "a beta version": Case(described((r'fmiVersion="[^"]*"', 'fmiVersion="3.0-beta.1"')), FmuFault.VERSION),
    "version 3.9": Case(described((r'fmiVersion="[^"]*"', 'fmiVersion="3.9"')), FmuFault.VERSION),
    "version 4": Case(described((r'fmiVersion="[^"]*"', 'fmiVersion="4.0"')), FmuFault.VERSION),
    "no interface": Case(
        described(
            (r"(?s)<CoSimulation.*?(/>|</CoSimulation>)", ""), (r"(?s)<ModelExchange.*?(/>|</ModelExchange>)", "")
        ),
        FmuFault.INTERFACE,
    ),
    "no variables": Case(described((r"(?s)<ModelVariables>.*</ModelVariables>", "")), FmuFault.DESCRIPTION),
    "a name twice": Case(
        described((r'name="velocity" valueReference="\d+"', 'name="position" valueReference="77"')),
        FmuFault.DUPLICATE_NAME,
    ),
    "a name twice among locals": Case(
        described(
            (
                r"</ModelVariables>",
                r'<Float64 name="v" valueReference="77"/><Float64 name="v" valueReference="78"/>\g<0>',
            )
        ),
        None,
    ),
    "a reference of another type": Case(
        described(
            (
                r"</ModelVariables>",
                r'<Int32 name="n" valueReference="0" causality="local" variability="discrete"/>\g<0>',
            )
        ),
        FmuFault.DUPLICATE_REFERENCE,
    ),
    "a negative reference": Case(
        described((r'(name="velocity" valueReference=)"\d+"', r'\1"-1"')), FmuFault.DUPLICATE_REFERENCE
    ),
    "a huge reference": Case(
        described((r'(name="velocity" valueReference=)"\d+"', r'\1"4294967296"')), FmuFault.DUPLICATE_REFERENCE
    ),
    "a huge dimension": Case(
        described(
            (
                r"</ModelVariables>",
                (
                    r'<Float64 name="v" valueReference="77" start="0"><Dimension start="99999999999"/>'
                    r'<Dimension start="99999999999"/></Float64>\g<0>'
                ),
            )
        ),
        FmuFault.DIMENSION,
    ),
    "a negative dimension": Case(
        described(
            (
                r"</ModelVariables>",
                (
                    r'<Float64 name="v" valueReference="77" start="0"><Dimension start="-3"/>'
                    r"</Float64>\g<0>"
                ),
            )
        ),
        FmuFault.DIMENSION,
    ),
    "a dimension without a variable": Case(
        described(
            (
                r"</ModelVariables>",
                (
                    r'<Float64 name="v" valueReference="77" start="0"><Dimension '
                    r'valueReference="999"/></Float64>\g<0>'
                ),
            )
        ),
        FmuFault.DIMENSION,
    ),
    "an illegal combination": Case(
        described(
            (
                r"</ModelVariables>",
                (
                    r'<Float64 name="v" valueReference="77" causality="parameter" '
                    r'variability="constant" start="0"/>\g<0>'
                ),
            )
        ),
        None,
    ),
    "an unknown type": Case(
        described((r"</ModelVariables>", r'<Float64 name="v" valueReference="77" declaredType="None"/>\g<0>')), None
    ),
    "an unknown derivative": Case(
        described((r"</ModelVariables>", r'<Float64 name="v" valueReference="77" derivative="999"/>\g<0>')), None
    ),
    "an unknown output": Case(described((r"<ModelStructure>", r'\g<0><Output valueReference="999"/>')), None),
    "an unknown dependency": Case(
        described((r'<Output valueReference="(\d+)"[^/]*/>', r'<Output valueReference="\1" dependencies="999"/>')), None
    ),
}

LIBRARIES = {
    "none": Case(lambda files: packed(without_library(files)), FmuFault.NO_BINARY),
    "an empty folder": Case(
        lambda files: packed(without_library(files), (binaries(files)[0].rpartition("/")[0] + "/", b"")),
        FmuFault.NO_BINARY,
    ),
    "for another platform": Case(
        lambda files: packed(without_library(files), ("binaries/riscv64-linux/plant.so", files[binaries(files)[0]])),
        FmuFault.NO_BINARY,
    ),
    "of another name": Case(other_name("other.so"), None, FmuFault.OTHER_NAME),
    "of two other names": Case(other_name("one.so", "two.so"), FmuFault.AMBIGUOUS),
    "empty": Case(library(lambda data: b""), FmuFault.TRUNCATED),
    "a text": Case(library(lambda data: b"version https://git-lfs.github.com/spec/v1\n"), FmuFault.TRUNCATED),
    "for another machine": Case(library(machine(0xB7)), FmuFault.OTHER_PLATFORM),
    "for 32 bits": Case(library(machine(0x03)), FmuFault.OTHER_PLATFORM),
    "for Windows": Case(
        library(lambda data: b"MZ" + bytes(58) + b"\x40\0\0\0" + b"PE\0\0\x64\x86" + bytes(500)),
        FmuFault.OTHER_PLATFORM,
    ),
    "for macOS": Case(library(lambda data: b"\xcf\xfa\xed\xfe\x0c\x00\x00\x01" + bytes(500)), FmuFault.OTHER_PLATFORM),
    "cut off in the header": Case(library(lambda data: data[:40]), FmuFault.TRUNCATED),
    "cut off in the segments": Case(library(lambda data: data[: len(data) // 2]), FmuFault.TRUNCATED),
    "an object file": Case(library(lambda data: data[:16] + b"\1\0" + data[18:]), FmuFault.TRUNCATED),
    "without a function": Case(
        library(lambda data: data.replace(b"fmi3EnterInitializationMode\0", b"fmi3enterInitializationMode\0")),
        FmuFault.MISSING_SYMBOL,
    ),
    "of another version": Case(
        library(lambda data: re.sub(rb"fmi3(\w+)\0", rb"fmi2\1\0", data)), FmuFault.MISSING_SYMBOL
    ),
}

CASES = {
    **{f"archive: {name}": case for name, case in ARCHIVES.items()},
    **{f"description: {name}": case for name, case in DESCRIPTIONS.items()},
    **{f"library: {name}": case for name, case in LIBRARIES.items()},
}
"""All cases by name."""


def good_files(file):
    """Return the files of a good FMU, with the library for this machine only."""
    from loopwright.fmus.platform import native_platform

    with zipfile.ZipFile(file) as archive:
        return {
            name: archive.read(name)
            for name in archive.namelist()
            if not name.startswith("binaries/") or name.startswith(f"binaries/{native_platform()}/")
        }
