"""Every use of a file or folder says in words of ours what is wrong with it, and one next step."""

import errno
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from loopwright.blocks import Constant, Gain, LoopwrightError, UnitDelay
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.cli import main
from loopwright.diagrams.compiled import load_compiled
from loopwright.fmus import Fmu, build, build_python, mass_spring_damper
from support.failing_disk import fail_below
from support.waiting import FAR

SOURCE = '__attribute__((visibility("default"))) int seven(void) { return 7; }'
FOUND = {
    errno.EACCES: "there is no permission to use '",
    errno.ENOSPC: "no space is left on the disk at '",
    errno.EROFS: "' is on a file system that can only be read; expected",
}


def diagram():
    @subsystem(sample_time=0.1, name="box")
    def box(u):
        return UnitDelay(initial_value=0.0, name="delay")(u)

    return Diagram("d", box(Constant(value=1.0, name="u")).named("y"))


def swept():
    return Diagram("swept", Gain(gain=2.0, name="gain")(Constant(value=1.0, name="u")).named("y"))


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """An FMU of ours outside of the cache of the test."""
    return mass_spring_damper.build(out=tmp_path_factory.mktemp("built"))


def moving(file):
    return Diagram("d", Fmu(file, name="plant", start={"force": 1.0}, isolate=False)())


CACHE = {
    "build": lambda file: mass_spring_damper.build(mass_spring_damper.nominal.replace(mass=3.0)),
    "unpack": lambda file: moving(file).simulate(0.01, step=1e-3, progress=False),
    "compile": lambda file: load_compiled(SOURCE),
}
"""Uses of the cache."""
OUT = {
    "build": lambda out: build(mass_spring_damper.nominal, out / "a.fmu"),
    "build_python": lambda out: build_python(mass_spring_damper.nominal, out / "a.fmu"),
    "to": lambda out: diagram().simulate(0.3, to=out / "run", compile=False, progress=False),
    "save": lambda out: diagram().simulate(0.3, compile=False, progress=False).save(out / "run"),
    "csv": lambda out: diagram().simulate(0.3, compile=False, progress=False).to_csv(out / "a.csv"),
    "mat": lambda out: diagram().simulate(0.3, compile=False, progress=False).to_mat(out / "a.mat"),
    "draw": lambda out: diagram().draw(out / "a.svg"),
    "sweep": lambda out: swept().sweep(
        {"gain.gain": [1.0, 2.0]}, 0.1, step=0.1, signals="y", to=out / "sweep", workers=1, progress=False
    ),
}
"""Files that a user asks for."""


def check(said, code, folder):
    assert FOUND[code] in said
    found = next(part for part in re.split(r"(?<=[.:]) ", said) if FOUND[code] in part)
    assert (str(folder) in found) or code == errno.ENOSPC
    assert said.endswith(" Make room there.") is (code == errno.ENOSPC)
    assert "make room" not in said
    assert said.count("; expected ") == 1
    assert "[Errno" not in said


@pytest.mark.parametrize("code", FOUND, ids=errno.errorcode.get)
@pytest.mark.parametrize("use", CACHE)
def test_a_cache_that_can_not_be_used(use, code, file, tmp_path, monkeypatch):
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(theirs / "cache" if use != "compile" else theirs))
    load_compiled.cache_clear()
    with monkeypatch.context() as failing:
        fail_below(failing, theirs, code)
        with pytest.raises(LoopwrightError) as caught:
            CACHE[use](file)
    check(str(caught.value), code, theirs)
    assert str(caught.value).endswith(" Set LOOPWRIGHT_CACHE to your own folder.") is (code != errno.ENOSPC)


@pytest.mark.parametrize("code", FOUND, ids=errno.errorcode.get)
@pytest.mark.parametrize("use", OUT)
@pytest.mark.drawn(4)
def test_a_file_that_a_user_asks_for_and_that_can_not_be_written(use, code, file, tmp_path, monkeypatch):
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    with monkeypatch.context() as failing:
        fail_below(failing, theirs, code)
        with pytest.raises(LoopwrightError) as caught:
            OUT[use](theirs)
    check(str(caught.value), code, theirs)


@pytest.mark.parametrize("code", FOUND, ids=errno.errorcode.get)
@pytest.mark.parametrize(
    "command",
    [["run", "A", "--out", "{}"], ["report", "A", "--out", "{}/a.html"], ["build", "dc_motor", "--out", "{}/a.fmu"]],
)
@pytest.mark.drawn
def test_commands_end_without_a_traceback(command, code, tmp_path, monkeypatch, capsys):
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    with monkeypatch.context() as failing:
        fail_below(failing, theirs, code)
        assert main([part.format(theirs) for part in command]) in (1, 2)
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.startswith("loopwright: error: ")
    check(said, code, theirs)


GONE = """
import os, sys
from loopwright.blocks import LoopwrightError
from loopwright.diagrams import Diagram
from loopwright.diagrams.cli import main
from loopwright.blocks import Constant
from loopwright.fmus import Fmu, mass_spring_damper
file = mass_spring_damper.build()
os.chdir(sys.argv[1])
os.rmdir(sys.argv[1])
def loaded(**options):
    return Diagram("d", Fmu(file, name="plant", start={"force": 1.0}, **options)())
mass_spring_damper.build()
loaded(isolate=True).simulate(0.01, step=1e-3, progress=False)
bare = Diagram("d", Constant(value=1.0))
def cache():
    os.environ["LOOPWRIGHT_CACHE"] = "cache"
    mass_spring_damper.build()
for act in (
    lambda: mass_spring_damper.build(out="a.fmu"),
    lambda: loaded(isolate=False).simulate(0.01, step=1e-3, progress=False),
    lambda: Fmu("a.fmu"),
    lambda: bare.simulate(0.1, step=0.1, to="run", progress=False),
    lambda: bare.draw("a.svg"),
    lambda: main(["run", "A"]),
    lambda: main(["build", "dc_motor"]),
    lambda: main(["report", "A"]),
    cache,
):
    try:
        act()
    except LoopwrightError as error:
        print(error, file=sys.stderr)
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="a working folder can't be removed on Windows")
def test_a_working_folder_that_was_removed(tmp_path):
    """Whatever needs none works; whatever does says what is missing."""
    gone = tmp_path / "gone"
    gone.mkdir()
    # -P: with the working folder on the path of modules, as for "-c" alone, Python 3.13.0 raises a SystemError in place
    # of an AttributeError of a module once that folder is removed (github.com/python/cpython/issues/130932)
    done = subprocess.run(
        [sys.executable, "-P", "-c", GONE, str(gone)], capture_output=True, text=True, check=True, timeout=FAR
    )
    said = [line for line in done.stderr.strip().splitlines() if not line.startswith("compiling ")]
    assert len(said) == 9
    for line in said:
        assert line.count("the working folder of this process has been removed; expected one that is there. ") == 1, (
            line
        )
        assert "No such file" not in line


@pytest.mark.parametrize("cache", [None, "~/cache"])
def test_a_user_without_a_home_folder(cache, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # as for a user whom the system doesn't know
    for name in ("LOOPWRIGHT_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    if cache is not None:
        monkeypatch.setenv("LOOPWRIGHT_CACHE", cache)
    with pytest.raises(LoopwrightError, match=r"^found no home folder for the cache, .* to your own folder\.$"):
        load_compiled(SOURCE + "/* no home */")
    assert list(tmp_path.iterdir()) == []  # no folder named "~"


@pytest.mark.slow
def test_processes_that_build_one_plant_at_once(tmp_path, monkeypatch):
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path))
    script = "from loopwright.fmus import mass_spring_damper; print(mass_spring_damper.build())"
    started = [subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) for _ in range(3)]
    files = {process.communicate(timeout=FAR)[0].strip() for process in started}
    assert len(files) == 1
    assert [file.name for file in Path(*files).parent.iterdir()] == ["mass_spring_damper.fmu"]


TEMPORARY = """
import os, sys, tempfile
from loopwright.fmus import FmuError, mass_spring_damper
resource = __import__("resource")
resource.setrlimit(resource.RLIMIT_FSIZE, (2000, resource.RLIM_INFINITY))
try:
    mass_spring_damper.build(mass_spring_damper.nominal.replace(mass=3.0))
except FmuError as error:
    print(error)
"""


@pytest.mark.skipif(os.name != "posix", reason="limits of a process")
def test_a_limit_on_files_while_a_plant_is_built(tmp_path):
    done = subprocess.run([sys.executable, "-c", TEMPORARY], capture_output=True, text=True, check=True)
    assert " grows beyond 2000 bytes, the largest file that this process may write (RLIMIT_FSIZE); " in done.stdout
    assert done.stdout.endswith("Lift it with 'ulimit -f unlimited' in the shell that starts Python.\n")


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EACCES], ids=errno.errorcode.get)
@pytest.mark.parametrize("use", ["build", "isolate"])
def test_a_full_folder_of_temporary_files(use, code, file, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    plant = Diagram("d", Fmu(file, name="plant", start={"force": 1.0}, isolate=True)())
    heavy = mass_spring_damper.nominal.replace(mass=4.0 + code)  # which no cache has
    with monkeypatch.context() as failing:
        fail_below(failing, tmp_path, code)
        with pytest.raises(LoopwrightError) as caught:
            plant.simulate(0.01, step=1e-3, progress=False) if use == "isolate" else mass_spring_damper.build(heavy)
    check(str(caught.value), code, tmp_path)
    assert ("can't be built: " if use == "build" else "can't be started: ") in str(caught.value)


def test_a_disk_that_is_full_after_some_files_of_an_fmu(file, monkeypatch):
    """The copies of all files fail, each with a text of its own in shutil's error; the first one counts."""

    def full(source, target, **options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), source, None, target)

    plant = Diagram("d", Fmu(file, name="plant", start={"force": 1.0}, isolate=True)())
    monkeypatch.setattr(shutil, "copy2", full)
    with pytest.raises(LoopwrightError) as caught:
        plant.simulate(0.01, step=1e-3, progress=False)
    said = str(caught.value)
    assert re.match(
        r"plant: the process .* can't be started: no space is left on the disk at '[^']*' for '[^']*'; ", said
    )
    assert "loopwright-fmu-" in said  # the file that could not be written, not the one that was read
    assert said.endswith("; expected some. Make room there.")


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such names")
@pytest.mark.parametrize(
    "name",
    [
        'it\'s 100% "quoted", with spaces',
        pytest.param("with spaces", marks=pytest.mark.slow),
        pytest.param('it\'s "quoted"', marks=pytest.mark.slow),
        pytest.param("100%", marks=pytest.mark.slow),
        pytest.param("ü λ 日本", marks=pytest.mark.slow),
        pytest.param("a:b", marks=pytest.mark.slow),
        pytest.param("%d $HOME #1 ;,&|<>*?[x]{y}~!@=+^`\\", marks=pytest.mark.slow),
    ],
)
def test_a_cache_of_any_name_compiles_unpacks_and_runs(name, file, tmp_path, monkeypatch):
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path / name))
    for variable in ("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR"):
        monkeypatch.delenv(variable, raising=False)  # the tests share one
    load_compiled.cache_clear()
    assert load_compiled(SOURCE)["seven"]() == 7
    assert [p.suffix for p in sorted((tmp_path / name / "compiled").iterdir())] != []
    built = mass_spring_damper.build()
    assert built.is_relative_to(tmp_path / name)
    assert built.read_bytes() == file.read_bytes()  # not a byte depends on the folder
    for isolate in (True, False):
        run = Diagram("d", Fmu(built, name="plant", start={"force": 1.0}, isolate=isolate)()).simulate(
            0.01, step=1e-3, progress=False
        )
        assert np.isfinite(run["plant.position"]).all()
