"""Hostile and broken SSPs meet the guard that FMUs meet: each is named by its fault, nothing is written elsewhere."""

import ctypes
import importlib
import random
import subprocess

import pytest

from loopwright import Diagram
from loopwright.diagrams import SspFileError, read_ssp
from loopwright.fmus import ArchiveLimits
from loopwright.fmus.child_processes.keeper import keep_folder, release_folder
from loopwright.types import FmuFault
from support.hostile import ARCHIVES, XML
from support.ssp_files import adder, component, description, pack, system

ROOT = system("root", component("a", "output y"))
OTHERS = {"without its beginning"}
"""Cases whose fault depends on the size of the archive."""
CASES = {n: case for n, case in ARCHIVES.items() if case.fault != FmuFault.NO_DESCRIPTION and n not in OTHERS}


@pytest.fixture(scope="module")
def good(cache, tmp_path_factory):
    """Files of a good SSP; the one that the cases of FMUs damage is a file more."""
    fmu = adder(tmp_path_factory.mktemp("adder")).read_bytes()
    return {
        "SystemStructure.ssd": description(ROOT).encode(),
        "resources/adder.fmu": fmu,
        XML: random.Random(0).randbytes(20_000),
    }


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with an SSP and a cache, in which every file is known; loading a library is refused."""

    def load(*arguments, **keywords):
        raise AssertionError("code of an FMU ran")

    keep_folder(tmp_path)  # the keeper of temporary folders is a process of ours: it runs before others are refused
    importlib.import_module("fmpy")  # it asks for the C library when it is imported
    monkeypatch.setattr(ctypes, "CDLL", load)
    monkeypatch.setattr(subprocess, "Popen", load)
    (tmp_path / "inside").mkdir()
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path / "inside" / "cache"))
    yield tmp_path / "inside"
    release_folder(tmp_path)


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n == "bomb" else n for n in CASES])
def test_a_bad_archive_is_named_by_its_fault(good, place, name):
    case, path = CASES[name], place / "x.ssp"
    path.write_bytes(case.make(good))
    if case.fault is None:
        assert list(Diagram.from_ssp(path, limits=case.limits).blocks) == ["a"]
    else:
        with pytest.raises(SspFileError) as caught:
            Diagram.from_ssp(path, limits=case.limits)
        assert caught.value.fault == case.fault, caught.value
        message = str(caught.value)
        assert str(path) in message
        assert message.endswith(".")
        assert "FMU" not in message
    outside = {p for p in place.parent.rglob("*") if not p.is_relative_to(place)}
    assert not outside
    assert not list(place.rglob("escaped*"))


ENTITY = '<!DOCTYPE x [<!ENTITY x "{}">]>'
TEXTS = {
    "no XML": ("no XML", FmuFault.XML),
    "nothing": ("", FmuFault.XML),
    "a web page": ("<html><body/></html>", FmuFault.DESCRIPTION),
    "deep": ("<a>" * 10**5 + "</a>" * 10**5, FmuFault.XML),
    "an entity": (ENTITY.format("a") + "<a>&x;</a>", FmuFault.ENTITY),
    "a file as an entity": ('<!DOCTYPE x [<!ENTITY x SYSTEM "file:///etc/passwd">]><a>&x;</a>', FmuFault.ENTITY),
    "another file's rules": ('<!DOCTYPE x SYSTEM "http://127.0.0.1:9/rules.dtd"><a/>', FmuFault.ENTITY),
    "version 3": (description(ROOT, version="3.0"), FmuFault.DESCRIPTION),
    "a draft": (description(ROOT).replace("/SSP1/", "/Draft20170606/"), FmuFault.DESCRIPTION),
}


@pytest.mark.parametrize("name", TEXTS)
def test_a_bad_description_is_named_by_its_fault(good, place, name):
    text, fault = TEXTS[name]
    path = pack(place / "x.ssp", {**good, "SystemStructure.ssd": text})
    with pytest.raises(SspFileError) as caught:
        read_ssp(path)
    assert caught.value.fault == fault, caught.value
    assert str(path) in str(caught.value)


def test_an_archive_without_a_description_says_where_one_is(good, place):
    path = pack(place / "x.ssp", {f"folder/{name}": content for name, content in good.items()})
    with pytest.raises(SspFileError, match=r"no description; .* There is folder/SystemStructure.ssd: pack the files"):
        read_ssp(path)
    with pytest.raises(SspFileError, match="expected an SSP"):
        read_ssp(place / "none.ssp")


def test_packages_within_packages_end(good, place):
    """An SSP that holds another, and so on, is read down to a depth, and refused beyond it."""
    inner = pack(place / "x.ssp", good).read_bytes()
    for depth in range(20):
        root = system("root", component("x", source="resources/x.ssp"))
        path = pack(place / "x.ssp", {"SystemStructure.ssd": description(root), "resources/x.ssp": inner})
        inner = path.read_bytes()
        if depth == 5:
            assert list(Diagram.from_ssp(path).blocks) == [6 * "x." + "a"]
    with pytest.raises(SspFileError, match="more than 16 levels"):
        read_ssp(path)


def test_an_fmu_in_it_meets_its_own_guard(good, place):
    path = pack(place / "x.ssp", {**good, "resources/adder.fmu": b"PK"})
    with pytest.raises(Exception, match=r"^a: .*adder.fmu' is no FMU"):
        Diagram.from_ssp(path)
    limits = ArchiveLimits(description=300)
    with pytest.raises(SspFileError, match=r"SystemStructure.ssd' in .* expected at most 300"):
        read_ssp(path, limits=limits)
