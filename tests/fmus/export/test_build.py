"""Builds: the same bytes, the cache, bad models, compilers that fail."""

import errno
import os
import shutil
import subprocess
import sys
import threading
import zipfile
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from fmpy.validation import validate_fmu

from loopwright.blocks.core.errors import CompilerError, DefinitionError, FmuError, ParameterError, UnitError
from loopwright.fmus import Variable, build_fmu
from loopwright.fmus.export import compiler as _compiler
from loopwright.fmus.export import fmu_package as _build
from loopwright.fmus.export.c_code import read_fmu_sources
from loopwright.fmus.export.compiler import TARGETS, compile_shared, find_compiler
from loopwright.fmus.platform import native_platform
from loopwright.fmus.toolchain import SUFFIXES
from support.exported import mass_spring_damper
from support.instances import run


@pytest.mark.slow
def test_same_input_same_bytes(msd, tmp_path, monkeypatch):
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("ZIG_LOCAL_CACHE_DIR", str(tmp_path / "local"))  # the model is compiled anew
    again = build_fmu(mass_spring_damper(), tmp_path / "again.fmu")
    assert again.read_bytes() == msd.read_bytes()
    with zipfile.ZipFile(again) as archive:
        assert {info.date_time for info in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


@pytest.mark.slow
def test_same_bytes_from_cold_caches_in_other_processes(tmp_path):
    code = "import sys, test_build as e; e.build_fmu(e.mass_spring_damper(), sys.argv[1])"
    for name in ("a", "b"):
        environment = {k: v for k, v in os.environ.items() if not k.startswith("ZIG_")}
        environment |= {"LOOPWRIGHT_CACHE": str(tmp_path / name)}
        environment["PYTHONPATH"] = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
        subprocess.run([sys.executable, "-c", code, tmp_path / f"{name}.fmu"], env=environment, check=True)
    assert (tmp_path / "a.fmu").read_bytes() == (tmp_path / "b.fmu").read_bytes()


def test_second_build_is_found(msd, monkeypatch, tmp_path):
    monkeypatch.setattr(_build, "_archive", lambda *args: pytest.fail("built again"))
    assert build_fmu(mass_spring_damper()) == msd
    copy = build_fmu(mass_spring_damper(), tmp_path)
    assert copy == tmp_path / "mass_spring_damper.fmu"
    assert copy.read_bytes() == msd.read_bytes()


def test_key_depends_on_everything(msd):
    compiler, native = find_compiler(), _build.Options(3, (native_platform(),))

    def key(**changes):
        return _build.build_key(mass_spring_damper(**changes), native, compiler)

    spec = mass_spring_damper()
    faster = Variable("force", "input", unit="N", start=1.0)
    keys = {
        key(),
        key(internal_step=1e-4),
        key(description=""),
        key(inputs=(faster,)),
        key(output=ca.Function("g", spec.derivative.sx_in(), [spec.derivative(*spec.derivative.sx_in())[0]])),
        _build.build_key(spec, _build.Options(3, ("aarch64-linux",)), compiler),
        _build.build_key(spec, _build.Options(2, (native_platform(),)), compiler),
        _build.build_key(spec, _build.Options(3, (native_platform(),), "text"), compiler),
        _build.build_key(spec, native, _compiler.Compiler(compiler.command, "another", zig=True)),
    }
    assert len(keys) == 9
    assert key() == key()


@pytest.mark.slow
def test_builds_at_once_in_threads(tmp_path, monkeypatch):
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path))
    built, spec = [], mass_spring_damper()
    threads = [threading.Thread(target=lambda: built.append(build_fmu(spec))) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(built) == 2
    assert len(set(built)) == 1
    assert validate_fmu(str(built[0])) == []
    assert [p.name for p in built[0].parent.iterdir()] == ["mass_spring_damper.fmu"]


@pytest.mark.parametrize(("platform", "said"), [("x86_64-windows", "takes minutes"), ("x86_64-linux", "takes longer")])
def test_how_long_the_first_build_takes_is_said_before_it(uncompiled, platform, said):
    lines = []
    build_fmu(mass_spring_damper(), platform=platform, notify=lines.append)
    assert lines == [f"compiling mass_spring_damper for {platform} (the first build on a machine {said})"]


# ---- bad models, and compilers that fail ----


@pytest.mark.parametrize(
    ("make", "error", "parts"),
    [
        (lambda: Variable("a b"), DefinitionError, ["'a b'", "letters"]),
        (lambda: Variable("time"), DefinitionError, ["'time' is reserved"]),
        (lambda: Variable("u", "input", "fixed"), DefinitionError, ["u has causality 'input'"]),
        (lambda: Variable("u", "input", shape=(0,)), DefinitionError, ["shape (0,)"]),
        (lambda: Variable("u", "input", unit="Nmm"), UnitError, ["Did you mean"]),
        (lambda: Variable("x", state=True), ParameterError, ["x is a state without a start value"]),
        (lambda: Variable("p", "parameter", "fixed"), ParameterError, ["p is a parameter without a start value"]),
        (lambda: Variable("y", "output", start=1.0), ParameterError, ["y is computed"]),
        (lambda: Variable("u", "input", start=np.nan), ParameterError, ["u has the start value nan", "finite"]),
        (lambda: Variable("u", "input", start=[1, 2]), ParameterError, ["shape ()"]),
        (lambda: Variable("u", "input", start=3.0, maximum=2.0), ParameterError, ["within [-inf, 2.0]"]),
        (lambda: mass_spring_damper(name="a-b"), DefinitionError, ["'a-b' is no C identifier"]),
        (lambda: mass_spring_damper(name="con"), DefinitionError, ["'con' is that of a device on Windows", "con_"]),
        (lambda: mass_spring_damper(name="Aux"), DefinitionError, ["no file Aux.fmu can be"]),
        (lambda: mass_spring_damper(name="LPT1"), DefinitionError, ["'LPT1' is that of a device"]),
        (lambda: mass_spring_damper(internal_step=0.0), ParameterError, ["internal_step", "positive"]),
        (lambda: mass_spring_damper(inputs=()), DefinitionError, ["derivative", "found u of", "column of 0"]),
        (lambda: mass_spring_damper(inputs=(Variable("force", "input"),)), DefinitionError, ["force without a unit"]),
        (
            lambda: mass_spring_damper(inputs=(Variable("mass", "input", unit="kg"),)),
            DefinitionError,
            ["'mass' names 2 variables"],
        ),
        (
            lambda: mass_spring_damper(derivative=mass_spring_damper().output),
            DefinitionError,
            ["mass_spring_damper.derivative", "found 1 x 1, expected a column of 2", "one derivative for each"],
        ),
        (lambda: mass_spring_damper(output=None), DefinitionError, ["expected a casadi.Function"]),
        (lambda: mass_spring_damper(states=(Variable("x"),)), DefinitionError, ["mass_spring_damper.x", "state=True"]),
    ],
)
def test_bad_models_are_refused(make, error, parts):
    with pytest.raises(error) as caught:
        make()
    for part in parts:
        assert part in str(caught.value)


def test_a_failing_compiler_is_quoted(tmp_path):
    with pytest.raises(CompilerError) as caught:
        compile_shared({"a.c": "int f(void) { return undeclared_thing; }"}, tmp_path / "a.so")
    message = str(caught.value)
    assert f"the C compiler failed for {native_platform()} with exit code" in message
    assert "undeclared_thing" in message
    assert "The command was: " in message
    assert list(tmp_path.iterdir()) == []


def test_a_failed_build_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path / "c"))
    monkeypatch.setattr(_build, "read_fmu_sources", lambda fmi: read_fmu_sources(fmi) | {"core.c": "#error broken"})
    with pytest.raises(CompilerError, match="broken"):
        build_fmu(mass_spring_damper(), tmp_path / "out.fmu")
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == []


def test_a_failed_write_leaves_nothing(tmp_path, monkeypatch):
    def fail(*args):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(FmuError, match=r"can't be written to .*: no space is left on the disk .* Make room there\.$"):
        _build.write_atomically(tmp_path / "a.fmu", b"data")
    assert list(tmp_path.iterdir()) == []


def test_no_compiler(monkeypatch, tmp_path):
    find = _compiler.importlib.util.find_spec
    monkeypatch.setattr(
        _compiler.importlib.util, "find_spec", lambda name, *a: None if name == "ziglang" else find(name, *a)
    )
    monkeypatch.setattr(_compiler.shutil, "which", lambda name: None)
    with pytest.raises(CompilerError) as caught:
        build_fmu(mass_spring_damper())
    assert str(caught.value) == (
        "no C compiler was found: neither the ziglang package nor cc, gcc or clang. "
        'Install one: pip install "loopwright[build]" (it brings ziglang), or set LOOPWRIGHT_CC to a command line.'
    )


@pytest.mark.slow
def test_a_compiler_of_ones_own(monkeypatch, instance, msd):
    if (gcc := shutil.which("gcc")) is None:
        pytest.skip("no gcc on this machine")
    monkeypatch.setenv("LOOPWRIGHT_CC", f"{gcc} -pipe")
    path = build_fmu(mass_spring_damper())
    assert path != msd
    assert run(instance(path).initialize(), 0.0, 100) == run(instance(msd).initialize(), 0.0, 100)
    monkeypatch.setenv("LOOPWRIGHT_CC", "no-such-compiler -x")
    with pytest.raises(CompilerError, match="there is no such command"):
        build_fmu(mass_spring_damper())


def test_unknown_platform():
    with pytest.raises(CompilerError, match=r"no platform 'x86_64-macos'. Did you mean .*'x86_64-darwin'"):
        build_fmu(mass_spring_damper(), platform="x86_64-macos")


def test_the_system_compiler_builds_for_its_own_platform_only():
    other = next(p for p in TARGETS if p != native_platform())
    with pytest.raises(CompilerError, match="builds for"):
        _compiler.check_platform(_compiler.Compiler(("cc",), "cc"), other)


@pytest.mark.slow
def test_all_platforms(tmp_path, cache):
    notes = []
    path = build_fmu(mass_spring_damper(), tmp_path / "all.fmu", platform=[*TARGETS], notify=notes.append)
    assert len(notes) == len(TARGETS)
    magic = {"linux": b"\x7fELF", "windows": b"MZ", "darwin": b"\xcf\xfa\xed\xfe"}
    with zipfile.ZipFile(path) as archive:
        for name in TARGETS:
            suffix = SUFFIXES[name.split("-")[1]]
            data = archive.read(f"binaries/{name}/mass_spring_damper{suffix}")
            assert data.startswith(magic[name.split("-")[1]])
            assert b"fmi3DoStep" in data
    assert validate_fmu(str(path)) == []


def test_unknown_version():
    with pytest.raises(FmuError, match=r"found fmi=1, expected 3 \(FMI 3.0\) or 2"):
        build_fmu(mass_spring_damper(), fmi=1)


def test_elements_have_names_of_their_own():
    with pytest.raises(DefinitionError, match="not made of identifiers"):
        Variable("angle[1]")
