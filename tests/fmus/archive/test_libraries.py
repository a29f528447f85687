"""Headers of libraries: held against LIEF's reading; cut off at any byte, and with any byte changed."""

import random
import struct

import pytest

from loopwright.fmus import mass_spring_damper
from loopwright.fmus.archive import missing_functions, read_library
from loopwright.fmus.platform import native_platform
from support.hostile import good_files

LINUX = pytest.mark.skipif(not native_platform().endswith("-linux"), reason="reads a library for Linux")


@pytest.fixture(scope="module")
def data(cache):
    return next(d for name, d in good_files(mass_spring_damper.build()).items() if name.startswith("binaries/"))


@LINUX
def test_symbols_and_needed_libraries_are_those_that_lief_reads(data):
    import lief  # it takes a second

    found, other = read_library(data), lief.parse(list(data))
    assert found.symbols == {s.name for s in other.exported_symbols}
    assert found.undefined == {
        s.name for s in other.imported_symbols if s.binding != lief.ELF.Symbol.BINDING.WEAK and s.name
    }
    assert list(found.needed) == list(other.libraries)
    assert found.platforms == (native_platform(),)
    assert not found.damage
    assert "fmi3DoStep" in found.symbols
    assert missing_functions(found, "3.0", model_exchange=False) == ()
    assert "fmi2Instantiate" in missing_functions(found, "2.0", model_exchange=False)
    assert missing_functions(found, "1.0", model_exchange=False) == ()


@LINUX
def test_a_library_that_is_cut_off_before_its_segments_end_is_damaged(data):
    """The loader maps the segments: from LIEF's numbers, a file that ends within one brings a process down."""
    import lief

    other = lief.parse(list(data))  # its segments live as long as it
    end = max(s.file_offset + s.physical_size for s in other.segments if s.type == lief.ELF.Segment.TYPE.LOAD)
    step = max(1, end // 200)
    for n in (*range(0, end, step), end - 1):
        assert read_library(data[:n]).damage, n
    assert not read_library(data[:end]).damage


@LINUX
@pytest.mark.parametrize("count", [300, pytest.param(20000, marks=pytest.mark.slow)])
def test_any_header_is_read_or_told(data, count):
    rng = random.Random(11)
    for _ in range(count):
        bad = bytearray(data)
        for _ in range(rng.randint(1, 4)):
            at = rng.randrange(64 if rng.random() < 0.3 else len(bad))
            bad[at : at + rng.choice((1, 2, 4, 8))] = rng.choice((b"\xff", b"\0", b"\x7f")) * rng.choice((1, 2, 4, 8))
        assert isinstance(read_library(bytes(bad)).damage, str)


@pytest.mark.parametrize(
    ("data", "platforms", "damage"),
    [
        (b"", (), "it is empty"),
        (b"\x7fELF", (), "it is cut off within its header, after 4 bytes"),
        (b"text", (), "it is no shared library: it starts with b'text'"),
        (b"\xcf\xfa\xed\xfe\x07\0\0\x01", ("x86_64-darwin",), ""),
        (
            b"\xca\xfe\xba\xbe\0\0\0\1\x01\0\0\x0c\0\0\0\0\0\0\x10\0\0\0\x20\0" + bytes(4),
            ("aarch64-darwin",),
            "it is cut off: it has 28 bytes; expected at least 12288",
        ),
        (
            b"MZ"
            + bytes(58)
            + b"\x40\0\0\0PE\0\0\x64\x86\1\0"
            + bytes(12)
            + b"\0\0\0\0"
            + bytes(16)
            + struct.pack("<II", 512, 1024)
            + bytes(20),
            ("x86_64-windows",),
            "it is cut off: it has 132 bytes; expected at least 1536",
        ),
    ],
)
def test_headers_of_other_systems(data, platforms, damage):
    found = read_library(data)
    assert (found.platforms, found.damage) == (platforms, damage)
