"""A run that waits for a compiler says so, where progress is shown."""

import math
import shutil

import pytest

from loopwright import Diagram, Fmu, margins, subsystem
from loopwright.blocks import Constant, Gain, Sine, StateSpace, Step
from loopwright.fmus.build_notes import announce_build, hear_builds
from loopwright.fmus.export import compile_shared, compiler
from loopwright.fmus.models import gantry


def test_what_is_compiled_is_told_and_its_end(tmp_path):
    heard = []
    with hear_builds(heard.append):
        compile_shared({"a.c": "int f(void) { return 1; }"}, tmp_path / "a.so")
    compile_shared({"a.c": "int f(void) { return 2; }"}, tmp_path / "b.so")  # nobody listens
    assert len(heard) == 2
    assert "compiling C code" in heard[0]
    assert heard[1] == ""


def test_the_first_start_of_a_compiler_is_announced(tmp_path, monkeypatch):
    zig = compiler.Compiler(("zig", "cc"), "zig", zig=True)
    monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", str(tmp_path / "zig"))
    assert "first start" in compiler._note(zig)
    assert "first start" not in compiler._note(compiler.Compiler(("cc",), "cc"))
    (tmp_path / "zig").mkdir()
    assert "first start" not in compiler._note(zig)


def test_the_end_is_told_of_a_compilation_that_fails():
    heard = []
    with pytest.raises(ZeroDivisionError), hear_builds(heard.append), announce_build("x"):
        raise ZeroDivisionError
    assert heard == ["x", ""]


@pytest.mark.parametrize("show", [True, False])
def test_a_run_says_that_it_compiles_where_progress_is_shown(show, monkeypatch):
    @subsystem(sample_time=0.1, name="box")
    def box(u):
        return 2.0 * u

    said = []

    class Status:
        def update(self, text):
            said.append(text)

        def start(self):
            said.append("start")

        def stop(self):
            said.append("stop")

    monkeypatch.setattr("rich.console.Console.status", lambda console, text: Status())
    monkeypatch.setattr("loopwright.diagrams.compiled.compiled_libraries._is_whole", lambda library: False)
    Diagram("d", box(Sine(frequency=0.1 + show)())).simulate(0.2, compile=True, progress=show)
    assert said[1:3] == (["start", "stop"] if show else [])
    assert not show or "compiling C code" in said[0]


def test_a_first_loop_and_an_fmu_need_no_compiler(tmp_path, monkeypatch):
    file = shutil.copy(gantry.build(), tmp_path / "foreign.fmu")
    monkeypatch.setenv("LOOPWRIGHT_CC", "no-such-compiler")
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path / "cache"))
    lag = StateSpace(A=[[-2.0]], B=[2.0], C=[1.0], name="lag")
    loop = Diagram("loop", lag(Gain(gain=3.0)(Step(times=0.0, values=1.0) - lag.y).named("u")).named("y"))
    run = loop.simulate(1.0, step=0.1, progress=False)
    assert run["y"][-1] == pytest.approx(0.75 * (1.0 - math.exp(-8.0)), rel=1e-3)
    assert margins(loop.linearize().loop("u")).stable
    force = Constant(value=(0.0, 0.0), name="force", unit="N")
    fallen = Diagram("fallen", Fmu(file, name="plant")(motor_force=force, external_force=force))
    made = fallen.simulate(0.01, step=0.001, progress=False)
    assert made["velocity"][-1, 1] < 0.0  # the upper axis sinks by its weight
    assert (run.tier, made.tier) == ("interpreted", "interpreted")
    kept = [found.name for found in (tmp_path / "cache").iterdir()]
    assert kept == ["unpacked"]  # the FMU's own library, and nothing that was compiled
