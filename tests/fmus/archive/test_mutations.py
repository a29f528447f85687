"""Archives, descriptions and libraries with random changes: they are read, or refused by errors of ours."""

import io
import random
import warnings
import zipfile

import pytest

from loopwright.blocks import LoopwrightError
from loopwright.fmus import FmuFileError, doctor, mass_spring_damper, read_description
from loopwright.fmus.archive import FmuArchive, unpack
from loopwright.types import FmuFault
from support.hostile import XML, good_files, packed


@pytest.fixture(scope="module")
def good(cache):
    """The files of a small FMU of FMI 3.0; its page and sources are left out, so that changes meet what is read."""
    files = good_files(mass_spring_damper.build())
    return {name: data for name, data in files.items() if name == XML or name.startswith("binaries/")}


def mutate(data, rng):
    """Change an archive at one or two places: bytes, numbers, parts that are cut out, doubled or moved."""
    data = bytearray(data)
    end = data.rindex(b"PK\5\6")
    directory = int.from_bytes(data[end + 16 : end + 20], "little")
    for _ in range(rng.randint(1, 2)):
        if not data:
            break
        at = rng.randrange(directory, end + 22) if rng.random() < 0.6 else rng.randrange(len(data))
        at, n = min(at, len(data) - 1), rng.choice((1, 2, 4, 8, 30))
        kind = rng.randrange(6)
        if kind == 0:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            data[at : at + n] = rng.choice((b"\xff", b"\0", b"\x7f", b"/", b"\\", b".")) * n
        elif kind == 2:
            del data[at : at + n]
        elif kind == 3:
            data[at:at] = data[at : at + n]
        elif kind == 4:
            del data[at:]
        else:
            data[at:at] = rng.randbytes(n)
    return bytes(data)


@pytest.mark.parametrize("count", [100, pytest.param(10000, marks=pytest.mark.slow)])
def test_mutated_archives_are_unpacked_whole_or_refused(good, tmp_path, monkeypatch, count):
    """Whatever is unpacked has the names and bytes of the table of contents, and lies in the folder for it."""
    rng, found = random.Random(2026), {True: 0, False: 0}
    start = {m: packed(good, method=m) for m in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)}
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path / "cache"))
    for k in range(count):
        data = mutate(start[rng.choice(list(start))], rng)
        path = tmp_path / f"{k}.fmu"
        path.write_bytes(data)
        try:
            description = read_description(path)
            folder = unpack(description)
        except FmuFileError as error:
            told = error
            found[False] += 1
        else:
            told = None
            with warnings.catch_warnings(), zipfile.ZipFile(io.BytesIO(data)) as archive:
                warnings.simplefilter("ignore")
                names = {"/".join(p for p in n.replace("\\", "/").split("/") if p) for n in archive.namelist()}
                written = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_file()}
                assert set(written) <= names
                assert written[XML].read_bytes() == archive.read(XML)
            found[True] += 1
        if told is not None:
            assert isinstance(told.fault, FmuFault), told
            assert str(path) in str(told)
        path.unlink()
    assert {path.name for path in tmp_path.iterdir()} <= {"cache"}
    assert min(found.values()) > count // 100


@pytest.mark.parametrize("count", [15, pytest.param(1000, marks=pytest.mark.slow)])
def test_the_doctor_takes_all_of_them(good, tmp_path, monkeypatch, count):
    rng, verdicts = random.Random(11), set()
    start = packed(good)
    monkeypatch.setattr("loopwright.fmus.checks.libraries.find_missing", lambda *_: ([], []))  # no process for each
    for k in range(count):
        path = tmp_path / f"{k}.fmu"
        path.write_bytes(mutate(start, rng))
        diagnosis = doctor(path, run=False)
        assert str(diagnosis)
        assert diagnosis.as_dict()["runs"] == diagnosis.runs
        assert diagnosis.runs or diagnosis.findings
        verdicts.add(diagnosis.verdict)
        path.unlink()
    assert len(verdicts) > (count > 100)


def test_an_archive_that_can_be_read_twice_is_the_same(good, tmp_path):
    path = tmp_path / "x.fmu"
    path.write_bytes(packed(good))
    archive = FmuArchive.open(path)
    assert {name: archive.read(name) for name in archive.files} == good
    assert {name: archive.read(name) for name in archive.files} == good
    with pytest.raises(LoopwrightError, match="has no file 'absent'"):
        archive.read("absent")
