"""Hostile and broken files: each is told by its fault, nothing is written elsewhere, nothing runs before the checks."""

import ctypes
import subprocess

import pytest

from loopwright.diagrams import Diagram
from loopwright.fmus import ArchiveLimits, Fmu, FmuFileError, mass_spring_damper, read_description
from loopwright.fmus.archive import FmuArchive, unpack
from loopwright.fmus.child_processes.keeper import keep_folder, release_folder
from loopwright.types import FmuFault
from support.hostile import ARCHIVES, CASES, XML, good_files, packed

BOMB = "archive: bomb"  # 120 MB


@pytest.fixture(scope="module")
def good(cache):
    return good_files(mass_spring_damper.build())


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with an FMU and a cache, in which every file is known; loading a library is refused."""

    def load(*arguments, **keywords):
        raise AssertionError("code of an FMU ran before it was checked")

    keep_folder(tmp_path)  # the keeper of temporary folders is a process of ours: it runs before others are refused
    monkeypatch.setattr(ctypes, "CDLL", load)
    monkeypatch.setattr(subprocess, "Popen", load)
    (tmp_path / "inside").mkdir()
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path / "inside" / "cache"))
    yield tmp_path / "inside"
    release_folder(tmp_path)


def files_in(folder):
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()}


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n == BOMB else n for n in CASES])
def test_a_bad_file_is_told_by_its_fault(good, place, name):
    case, path = CASES[name], place / "plant.fmu"
    path.write_bytes(case.make(good))
    if case.fault is None:
        description = read_description(path, limits=case.limits)
        folder = unpack(description)
        assert {finding.fault for finding in description.findings} == ({case.finding} if case.finding else set())
        assert all(finding.found and finding.step for finding in description.findings)
        assert files_in(folder) == set(FmuArchive.open(path).files)
        assert (folder / description.binary).is_file()
    else:
        with pytest.raises(FmuFileError) as caught:
            unpack(read_description(path, limits=case.limits))
        assert caught.value.fault == case.fault, caught.value
        message = str(caught.value)
        assert str(path) in message
        assert message.endswith(".")
        assert "Traceback" not in message
        assert "Error:" not in message.split(": ", 1)[0]
        assert not [name for name in files_in(place) if not name.startswith("cache/") and name != "plant.fmu"]
        assert not files_in(place / "cache")
    assert {path.name for path in place.parent.iterdir()} == {"inside"}


def test_the_good_file_is_good(good, place):
    path = place / "plant.fmu"
    path.write_bytes(packed(good))
    description = read_description(path)
    assert not description.findings
    assert not description.complaints
    folder = unpack(description)
    assert {name: (folder / name).read_bytes() for name in good} == good


def test_paths_with_backslashes_are_paths(good, place):
    """The same files are unpacked as from the good archive."""
    path = place / "plant.fmu"
    path.write_bytes(ARCHIVES["backslashes"].make(good))
    folder = unpack(read_description(path))
    assert {name: (folder / name).read_bytes() for name in good} == good


@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("archive: large", {"size": 2 * 10**6}),
        pytest.param("archive: bomb", {"ratio": 10**4}, marks=pytest.mark.slow),
        ("archive: many files", {"entries": 200}),
        ("description: too long", {"description": 10**6}),
        ("description: a huge dimension", {"elements": 10**23}),
    ],
)
def test_limits_can_be_raised(good, place, name, fields):
    path = place / "plant.fmu"
    path.write_bytes(CASES[name].make(good))
    limits = ArchiveLimits(**fields)
    if "elements" in fields:
        with pytest.raises(FmuFileError) as caught:  # beyond any memory
            read_description(path, limits=limits)
        assert caught.value.fault in (FmuFault.DESCRIPTION, FmuFault.TOO_LARGE)
    else:
        assert unpack(read_description(path, limits=limits)).is_dir()


@pytest.mark.parametrize("fields", [{"size": 0}, {"entries": -1}, {"ratio": float("nan")}, {"elements": True}])
def test_limits_are_positive(fields):
    (name,) = fields
    with pytest.raises(ValueError, match=rf"^limits\.{name}: found .*; expected a positive number"):
        ArchiveLimits(**fields)


def test_a_file_that_has_changed_since_it_was_read_is_not_unpacked(good, place):
    path = place / "plant.fmu"
    path.write_bytes(packed(good))
    description = read_description(path)
    path.write_bytes(packed({**good, "resources/new": b""}))
    with pytest.raises(FmuFileError, match="has changed since its description was read"):
        unpack(description)


def test_a_large_file_is_refused_before_it_is_unpacked(place):
    """The table of contents is enough: 10 GB of zeros are not read."""
    path = place / "plant.fmu"
    data = bytearray(packed({XML: b"x", "resources/zeros": bytes(10)}))
    at = data.index(b"PK\1\2", data.index(b"PK\1\2") + 1)
    data[at + 24 : at + 28] = (0xFFFFFFF0).to_bytes(4, "little")
    path.write_bytes(data)
    with pytest.raises(FmuFileError) as caught:
        read_description(path)
    assert caught.value.fault == FmuFault.RATIO
    assert caught.value.subject == "resources/zeros"


def test_the_messages_of_a_run_tell_what_is_wrong_with_the_file(good, tmp_path, monkeypatch):
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path / "cache"))
    path = tmp_path / "plant.fmu"
    path.write_bytes(CASES["library: of another name"].make(good))
    plant = Fmu(path, name="plant", start={"force": 1.0}, isolate=False)
    _, message = Diagram("d", plant()).simulate(0.01, step=1e-3, progress=False).messages
    assert message == (
        "plant: its library is called other.so, as the only one in its folder; expected the model identifier, "
        "mass_spring_damper"
    )
