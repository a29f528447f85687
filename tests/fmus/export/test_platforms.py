"""Binaries for all platforms, read by a parser of their formats (they can't be run here), and builds to the same bytes."""

import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import fmpy
import pytest
from fmpy.validation import validate_fmu

from loopwright.fmus import build_fmu
from loopwright.fmus.platform import native_platform
from loopwright.fmus.toolchain import TARGETS
from support import TESTS
from support.exported import pendulums

FOLDERS = {
    3: {name: name for name in TARGETS},
    2: {
        "x86_64-linux": "linux64",
        "x86_64-windows": "win64",
        "x86_64-darwin": "darwin64",
        "aarch64-linux": "aarch64-linux",
        "aarch64-darwin": "aarch64-darwin",
    },
}
SUFFIX = {"linux": "so", "windows": "dll", "darwin": "dylib"}
# What a library may need: what every system of its kind brings.
NEEDED = {
    "linux": r"lib[cm]\.so\.6",
    "windows": r"KERNEL32\.dll|api-ms-win-crt-\w+-l1-1-0\.dll",
    "darwin": r"/usr/lib/libSystem\.B\.dylib|pendulums\.dylib",  # its own name is among its libraries
}


def functions_of_the_standard(fmi):
    header = (Path(fmpy.__file__).parent / "c-code" / f"fmi{fmi}Functions.h").read_text()
    return set(re.findall(rf"^\s*FMI{fmi}_Export\s+fmi{fmi}\w+TYPE\s+(fmi{fmi}\w+);", header, re.MULTILINE))


@pytest.fixture(scope="module")
def everywhere(cache):
    """Both versions for all platforms; Windows takes minutes the first time, as its C library is built from source."""
    return {fmi: build_fmu(pendulums(), fmi=fmi, platform="all") for fmi in (3, 2)}


def binaries(path, fmi):
    lief = pytest.importorskip("lief")
    with zipfile.ZipFile(path) as archive:
        for name in TARGETS:
            system = name.split("-")[1]
            data = archive.read(f"binaries/{FOLDERS[fmi][name]}/pendulums.{SUFFIX[system]}")
            yield lief, name, system, lief.parse(data)


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [3, 2])
def test_all_platforms_in_one_fmu(everywhere, fmi):
    assert validate_fmu(str(everywhere[fmi])) == []
    with zipfile.ZipFile(everywhere[fmi]) as archive:
        found = [n for n in archive.namelist() if n.startswith("binaries/")]
    suffixes = {platform: SUFFIX[platform.split("-")[1]] for platform in TARGETS}
    assert sorted(found) == sorted(f"binaries/{FOLDERS[fmi][p]}/pendulums.{suffixes[p]}" for p in TARGETS)


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [3, 2])
def test_each_exports_the_functions_of_its_standard_and_no_others(everywhere, fmi):
    expected = functions_of_the_standard(fmi)
    assert len(expected) == {3: 75, 2: 44}[fmi]
    for _, _, system, binary in binaries(everywhere[fmi], fmi):
        names = {f.name.removeprefix("_") if system == "darwin" else f.name for f in binary.exported_functions}
        linkers = {"__dso_handle", "_mh_dylib_header"} if system == "darwin" else set()
        assert names - linkers == expected


@pytest.mark.slow
@pytest.mark.parametrize("fmi", [3, 2])
def test_each_is_of_its_architecture_and_needs_only_the_system(everywhere, fmi):
    for lief, name, system, binary in binaries(everywhere[fmi], fmi):
        arm = name.startswith("aarch64")
        libraries = [getattr(library, "name", library) for library in binary.libraries]
        assert [library for library in libraries if not re.fullmatch(NEEDED[system], library)] == []
        if system == "linux":
            assert binary.header.machine_type == (lief.ELF.ARCH.AARCH64 if arm else lief.ELF.ARCH.X86_64)
            assert binary.header.file_type == lief.ELF.Header.FILE_TYPE.DYN
            versions = [v.name for r in binary.symbols_version_requirement for v in r.get_auxiliary_symbols()]
            assert versions
            assert max(tuple(map(int, v.removeprefix("GLIBC_").split("."))) for v in versions) <= (2, 17)
        elif system == "windows":
            assert binary.header.machine == lief.PE.Header.MACHINE_TYPES.AMD64
            assert binary.header.has_characteristic(lief.PE.Header.CHARACTERISTICS.DLL)
        else:
            assert binary.header.cpu_type == (
                lief.MachO.Header.CPU_TYPE.ARM64 if arm else lief.MachO.Header.CPU_TYPE.X86_64
            )
            assert binary.header.file_type == lief.MachO.Header.FILE_TYPE.DYLIB
            assert tuple(binary.build_version.minos) == (11, 0, 0)
            assert binary.has_code_signature or not arm  # Apple's processors run no unsigned code


@pytest.mark.slow
def test_the_native_binary_is_the_same_alone_and_among_others(everywhere):
    for fmi, path in everywhere.items():
        alone = build_fmu(pendulums(), fmi=fmi)
        with zipfile.ZipFile(path) as many, zipfile.ZipFile(alone) as one:
            assert set(one.namelist()) < set(many.namelist())
            assert [n for n in one.namelist() if one.read(n) != many.read(n)] == []
            assert any(FOLDERS[fmi][native_platform()] in n for n in one.namelist())


# ---- same input, same bytes ----

BUILD = """
import sys
from support import exported
from loopwright.fmus import build_fmu
for fmi, arrays in ((3, True), (3, False), (2, True)):
    for make in (exported.mass_spring_damper, exported.pendulums):
        out = f"{sys.argv[1]}/{make.__name__}-{fmi}-{arrays}.fmu"
        build_fmu(make(), out, fmi=fmi, arrays=arrays, platform=sys.argv[2] or None)
"""


def built(folder, seed, platform=""):
    """Build in another process, folder and cache, with hashes that begin elsewhere; give the files' bytes."""
    (folder / "elsewhere").mkdir(parents=True)
    kept = {k: v for k, v in os.environ.items() if k != "ZIG_LOCAL_CACHE_DIR"}
    paths = [str(TESTS), *filter(None, sys.path)]
    new = {"PYTHONHASHSEED": seed, "PYTHONPATH": os.pathsep.join(paths), "TMPDIR": str(folder / "elsewhere")}
    new["LOOPWRIGHT_CACHE"] = str(folder / "cache")
    subprocess.run([sys.executable, "-c", BUILD, str(folder), platform], env=kept | new, cwd=folder, check=True)
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.fmu"))}


@pytest.mark.slow
def test_same_bytes_from_processes_with_other_hash_seeds(tmp_path):
    """The C library's objects are shared, the models are compiled anew."""
    results = [built(tmp_path / seed, seed) for seed in ("1", "2")]
    assert len(results[0]) == 6
    assert results[0] == results[1]


@pytest.mark.slow
def test_same_bytes_from_cold_caches(tmp_path, monkeypatch):
    monkeypatch.delenv("ZIG_GLOBAL_CACHE_DIR")
    assert built(tmp_path / "a", "1") == built(tmp_path / "b", "2")


@pytest.mark.slow
def test_same_bytes_for_all_platforms(tmp_path, everywhere):
    again = built(tmp_path / "a", "3", "all")
    assert again["pendulums-3-True.fmu"] == everywhere[3].read_bytes()
    assert again["pendulums-2-True.fmu"] == everywhere[2].read_bytes()
