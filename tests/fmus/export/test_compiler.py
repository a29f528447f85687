"""Compilers that don't end, and a cache that can't be written."""

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from loopwright.fmus import CompilerError, FmuError, bouncing_ball, build_notes, gantry, mass_spring_damper
from loopwright.fmus.export import compiler as _compiler
from loopwright.fmus.export.compiler import Compiler, compile_shared
from support.waiting import FAR, is_there, wait_for

LINUX = pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks processes up in /proc")

SPINNING = """
import os, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1e4)"])
with open(sys.argv[1] + ".new", "w") as file:
    file.write(f"{os.getpid()} {child.pid}")
os.rename(sys.argv[1] + ".new", sys.argv[1])
time.sleep(1e4)
"""


@pytest.fixture
def spinning(tmp_path):
    """A compiler that never ends, has a child, and writes both process numbers to a file."""
    (tmp_path / "spin.py").write_text(SPINNING)
    pids = tmp_path / "pids"
    return Compiler((sys.executable, str(tmp_path / "spin.py"), str(pids)), "spinning"), pids


@pytest.mark.parametrize("model", [mass_spring_damper, bouncing_ball])
def test_an_exported_model_compiles_without_a_word(model, tmp_path, monkeypatch):
    """A warning would compile each model again in each session: tests keep what is clean (`support.kept_libraries`)."""
    compile_it, said = _compiler._wait, []
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(_compiler, "_wait", lambda *of: said.append(compile_it(*of)) or said[-1])
    model.build(out=tmp_path)
    assert said == [(0, "", "")]


def assert_ended(pids):
    ids = [int(pid) for pid in pids.read_text().split()]
    assert len(ids) == 2
    assert wait_for(lambda: [pid for pid in ids if is_there(pid)], []) == []


@pytest.mark.slow
@LINUX
def test_a_compiler_that_does_not_end_is_stopped_with_its_children(tmp_path, spinning, monkeypatch):
    compiler, pids = spinning
    monkeypatch.setattr(_compiler, "TIMEOUT", 5.0)
    with pytest.raises(
        CompilerError, match=r"the C compiler did not end within 5 s and was stopped\. The command was: "
    ):
        compile_shared({"a.c": ""}, tmp_path / "a.so", compiler=compiler)
    assert_ended(pids)


@pytest.mark.slow
@LINUX
def test_an_interrupt_ends_the_compiler(tmp_path, spinning):
    compiler, pids = spinning
    script = (
        "import signal, sys; from pathlib import Path; from loopwright.fmus.export.compiler import Compiler, compile_shared\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a background job begins with it ignored
        f"compile_shared({{'a.c': ''}}, Path({str(tmp_path / 'a.so')!r}), compiler=Compiler({compiler.command!r}, ''))"
    )
    process = subprocess.Popen([sys.executable, "-c", script], stderr=subprocess.PIPE)
    assert wait_for(pids.exists)
    process.send_signal(signal.SIGINT)
    assert b"KeyboardInterrupt" in process.communicate(timeout=FAR)[1]
    assert_ended(pids)


def test_a_version_that_never_comes(monkeypatch):
    def hang(command, seconds):
        raise subprocess.TimeoutExpired(command, seconds)

    monkeypatch.setattr(_compiler, "run_in_group", hang)
    monkeypatch.setenv("LOOPWRIGHT_CC", f"{sys.executable} -hang")
    with pytest.raises(CompilerError, match=r"can't be run: .* timed out after 60 seconds\. Install one"):
        _compiler.find_compiler()


@pytest.mark.parametrize("where", ["file", "/proc/none", "/sys/none"])
def test_a_cache_that_can_not_be_written_is_named(where, tmp_path, monkeypatch):
    if where == "file":
        (tmp_path / "file").write_text("")
        where = str(tmp_path / "file" / "cache")
    elif not os.path.isdir(os.path.dirname(where)):
        pytest.skip("no such folder on this system")
    monkeypatch.setenv("LOOPWRIGHT_CACHE", where)
    with pytest.raises(FmuError) as caught:
        gantry.build(gantry.nominal.replace(gravity=1.0), out=tmp_path / "out.fmu")
    assert not isinstance(caught.value, CompilerError)
    assert str(caught.value).endswith(" Set LOOPWRIGHT_CACHE to your own folder.")
    if where.endswith("none"):
        assert f"the cache folder {where!r} can't be used: " in str(caught.value)
    else:
        assert f": '{tmp_path}/file' is a file; expected a folder. " in str(caught.value)


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_terminal_is_told_of_a_build_that_takes_longer_and_is_clean_again(monkeypatch):
    for out, late, shown in ((Terminal(), 0.01, True), (Terminal(), 100.0, False), (io.StringIO(), 0.0, False)):
        monkeypatch.setattr("sys.stderr", out)
        monkeypatch.setattr(build_notes, "LATE", late)
        with build_notes.announce_build("compiling C code"):
            while shown and not out.getvalue():
                time.sleep(0.005)
            told = out.getvalue()
        assert told == ("compiling C code …" if shown else "")
        assert out.getvalue() == (f"{told}\r{' ' * len(told)}\r" if shown else "")
