"""``loopwright build``, ``inspect``, ``validate``: files, texts, exit statuses; FMUs of ours and of others."""

import ctypes
import errno
import hashlib
import json
import os
import shutil
import subprocess
import sys
import zipfile

import fmpy
import numpy as np
import pytest
from lxml import etree

from loopwright.diagrams.cli import build as _build
from loopwright.diagrams.cli.command_line import main
from loopwright.fmus.archive import read_library
from loopwright.fmus.checks import summary as _summary
from loopwright.fmus.checks import trial as _trial
from loopwright.fmus.export.compiler import find_compiler
from loopwright.fmus.export.fmu_package import zip_files
from loopwright.fmus.platform import native_platform
from support.failing_disk import fail_below
from support.zoo import zoo_fmu

LINUX = pytest.mark.skipif(
    native_platform() != "x86_64-linux", reason="makes broken libraries with Linux's own tools, for x86_64"
)

MODELS = '''
"""Models of mine."""
import math

import numpy as np

import constants
from loopwright.blocks import Block, Input, Output, State, parameter

print("loaded")


class Lag(Block):
    """First-order lags: T ẏ = u − y [both]."""

    time_constant: float = parameter(default=0.5, unit="s", above=0.0, description="time constant T")
    u = Input(shape=(2,), unit="V", description="input u")
    y = State(start=(1.0, 2.0), unit="V", description="output y", output=True)
    total = Output(unit="V", description="sum")

    def derivative(self, t, x, u):
        return (u.u - x.y) / self.time_constant

    def output(self, t, x, u):
        return x.y[0] + x.y[1] + constants.OFFSET


class Needs(Lag):
    """Needs a parameter."""

    mass: float = parameter(unit="kg")
    length: float = parameter(unit="m")


class Branches(Lag):
    """A branch in Python."""

    def derivative(self, t, x, u):
        if x.y[0] > 5.0:
            return np.zeros(2)
        return (u.u - x.y) / self.time_constant


class Static(Block):
    """No state."""

    y = Output()

    def output(self, t, x, u):
        return t


class Unlucky(Block):
    """Fails when it is made."""

    k: float = parameter(default=1.0)
    y = State(output=True)

    def check(self):
        raise RuntimeError("no luck")


fast = Lag(time_constant=0.25)
number = 3
'''


@pytest.fixture
def here(tmp_path, monkeypatch):
    """The current folder, with a file of models."""
    (tmp_path / "mine.py").write_text(MODELS, encoding="utf-8")
    (tmp_path / "constants.py").write_text("OFFSET = 10.0\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def names(folder):
    return sorted(str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file())


def line_of(text):
    return next(i for i, line in enumerate(MODELS.splitlines(), 1) if text in line)


SOURCES = ["constants.py", "mine.py"]


@pytest.fixture(scope="module")
def lag(tmp_path_factory):
    """lag.fmu of FMI 3.0 and lag2.fmu of 2.0, built by the command."""
    folder = tmp_path_factory.mktemp("lag")
    (folder / "mine.py").write_text(MODELS, encoding="utf-8")
    (folder / "constants.py").write_text("OFFSET = 10.0\n")
    for fmi, name in ((3, "lag"), (2, "lag2")):
        build = ["build", f"{folder / 'mine.py'}:Lag", "--fmi", str(fmi), "--name", name, "--out", str(folder)]
        assert main(build) == 0
    return folder


@pytest.fixture
def altered(lag, tmp_path):
    """altered("lag.fmu", description=..., files=...) -> a changed copy."""

    def alter(source, *, description=None, files=None, drop=()):
        with zipfile.ZipFile(lag / source) as archive:
            content = {name: archive.read(name) for name in archive.namelist()}
        if description is not None:
            root = etree.fromstring(content["modelDescription.xml"])
            description(root)
            content["modelDescription.xml"] = etree.tostring(root)
        content.update(files or {})
        path = tmp_path / "altered.fmu"
        path.write_bytes(zip_files({k: v for k, v in content.items() if k not in drop}))
        return path

    return alter


# --- build ----------------------------------------------------------------------------------------------------------


def test_a_model_of_ones_own_goes_all_the_way(here, capsys):
    assert main(["build", "mine.py:fast", "--internal-step", "1e-3"]) == 0
    out, err = capsys.readouterr()
    file = here / "lag.fmu"
    first, second, third = out.splitlines()
    assert first == f"{file}  ({file.stat().st_size / 1e3:.1f} kB)"
    assert second.startswith("FMI 3.0, co-simulation")
    assert third == f"platforms: {native_platform()}"
    assert err.splitlines()[:2] == ["loaded", "tracing lag"]  # what the file prints is no result
    assert names(here) == sorted([*SOURCES, "lag.fmu"])

    assert main(["inspect", "lag.fmu", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    variables = {v["name"]: v for v in found["variables"]}
    assert variables["time_constant"]["start"] == 0.25
    assert variables["internal_step"]["start"] == 1e-3
    assert main(["validate", "lag.fmu"]) == 0
    assert capsys.readouterr().out.startswith("lag.fmu: clean\n")

    u = np.array([(0.0, 3.0, -1.0)], dtype=[("time", float), ("u[1]", float), ("u[2]", float)])
    assert main(["build", "mine.py:fast", "--no-arrays"]) == 0
    result = fmpy.simulate_fmu(
        str(file),
        stop_time=1.0,
        output_interval=0.1,
        input=u,
        output=["y[1]", "y[2]", "total"],
        fmi_type="CoSimulation",
    )
    for t, *values in result:
        y = [3.0 - 2.0 * np.exp(-4 * t), -1.0 + 3.0 * np.exp(-4 * t)]
        assert values == pytest.approx([*y, sum(y) + 10.0], abs=1e-11)  # (4e-3)⁵ / 120 a step, 1000 steps


@pytest.mark.slow
def test_nothing_of_the_file_stays_loaded(here, capsys, uncompiled):
    """A second build finds what has changed, and another file of the same name."""
    before, path = dict(sys.modules), list(sys.path)
    assert main(["build", "mine.py:Lag"]) == 0
    new = {n for n, m in sys.modules.items() if n not in before and str(here) in str(getattr(m, "__file__", ""))}
    assert new == set()
    assert "loopwright_user_model" not in sys.modules
    assert sys.path == path
    first = (here / "lag.fmu").read_bytes()
    (here / "other").mkdir()
    (here / "other" / "mine.py").write_text(MODELS, encoding="utf-8")
    (here / "other" / "constants.py").write_text("OFFSET = -7.0\n")
    assert main(["build", "other/mine.py:Lag", "--out", "other"]) == 0
    assert (here / "other" / "lag.fmu").read_bytes() != first
    assert names(here) == sorted([*SOURCES, "lag.fmu", "other/constants.py", "other/lag.fmu", "other/mine.py"])
    assert main(["build", "mine.py:Lag"]) == 0
    assert (here / "lag.fmu").read_bytes() == first


@pytest.mark.slow
def test_a_plant_as_fmi_2(here, capsys):
    assert main(["build", "mass_spring_damper", "--fmi", "2", "--name", "msd", "--out", "new/folder"]) == 0
    out, err = capsys.readouterr()
    file = here / "new" / "folder" / "msd.fmu"
    assert out.splitlines()[0].startswith(f"{file.relative_to(here)}  (")
    assert "FMI 2.0, co-simulation" in out
    assert "tracing msd" in err
    description = fmpy.read_model_description(str(file), validate=True)
    assert (description.fmiVersion, description.modelName) == ("2.0", "msd")
    result = fmpy.simulate_fmu(
        str(file), stop_time=1.0, output_interval=0.25, output=["position"], fmi_type="CoSimulation"
    )
    w = np.sqrt(100 - 0.25)  # m = d = 1, k = 100, s(0) = 0.1
    exact = 0.1 * np.exp(-0.5 * result["time"]) * (np.cos(w * result["time"]) + 0.5 / w * np.sin(w * result["time"]))
    assert result["position"] == pytest.approx(exact, abs=1e-9)


def test_a_file_to_write(here, uncompiled):
    assert main(["build", "mine.py:Lag", "--out", "a/b.fmu"]) == 0
    (here / "a" / "b.fmu").write_text("of an older build")
    assert main(["build", "mine.py:Lag", "--out", "a/b.fmu"]) == 0
    assert fmpy.read_model_description(str(here / "a" / "b.fmu")).modelName == "lag"
    assert names(here) == sorted(["a/b.fmu", *SOURCES])


def test_what_was_built_comes_as_json(here, uncompiled, capsys):
    assert main(["build", "mine.py:Lag", "--out", "c.fmu", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["file"], found["model_name"]) == ("c.fmu", "lag")
    assert found["size"] == (here / "c.fmu").stat().st_size


def test_platforms(here, capsys, monkeypatch):
    """Names reach the builder; compiling for others is tested with the compiler."""
    asked = []

    def build(block, out, **options):
        asked.append(options["platform"])
        raise KeyboardInterrupt

    monkeypatch.setattr(_build, "build_model", build)
    for given in (["x86_64-windows", "x86_64-linux"], ["aarch64-darwin", "all"]):
        assert main(["build", "mine.py:Lag", "--platform", *given]) == 130
    assert asked == [["x86_64-windows", "x86_64-linux"], "all"]
    assert "interrupted; nothing is written" in capsys.readouterr().err
    assert names(here) == SOURCES


def test_integrator_and_tolerance(here, uncompiled):
    assert main(["build", "mine.py:Lag", "--integrator", "dopri5", "--tolerance", "1e-6"]) == 0
    variables = {v.name: v for v in fmpy.read_model_description("lag.fmu").modelVariables}
    assert float(variables["integrator"].start) == 2
    assert float(variables["tolerance"].start) == 1e-6


@pytest.mark.slow
def test_python_inside(here, capsys):
    assert main(["build", "mine.py:Branches"]) == 1
    err = capsys.readouterr().err
    assert f"in line {line_of('if x.y[0] > 5.0:')} of {here / 'mine.py'}" in err
    assert "a symbol has no truth value while it is traced" in err
    assert err.rstrip().endswith("Or put its Python code inside: --python.")
    assert names(here) == SOURCES
    assert main(["build", "mine.py:Branches", "--python", "--name", "b"]) == 0
    out = capsys.readouterr().out
    assert "FMI 2.0, co-simulation\n" in out
    assert "It needs Python" in out
    assert main(["validate", "b.fmu"]) == 0
    assert main(["inspect", "b.fmu"]) == 0
    text = capsys.readouterr().out
    assert "needsExecutionTool" in text
    assert "It needs Python" in text
    result = fmpy.simulate_fmu("b.fmu", stop_time=1.0, output_interval=0.5, output=["y[1]", "total"])
    t = result["time"]
    assert result["y[1]"] == pytest.approx(np.exp(-2 * t), abs=1e-12)
    assert result["total"] == pytest.approx(3 * np.exp(-2 * t) + 10.0, abs=1e-11)


# --- build: what goes wrong -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ([], "the following arguments are required: MODEL"),
        (["gantri"], "there is no model 'gantri'. Did you mean 'gantry'"),
        (["gantri"], "The plants: bouncing_ball, dc_motor, gantry, "),
        (["zzz"], "there is no model 'zzz'. Known: bouncing_ball, "),
        (["nothing.py:Lag"], "MODEL: there is no file 'nothing.py'. Check the path."),
        (
            ["mine.py"],
            "expected FILE.py:Name. Its models: Lag, Needs, Branches, Static, Unlucky, fast. Write mine.py:Lag.",
        ),
        (["mine.py:lag"], "there is no 'lag' in it. Did you mean 'Lag'?"),
        (["constants.py:Lag"], "there is no 'Lag' in it. There is no Block in it."),
        (["mine.py:number"], "found int for 'number'; expected a Block"),
        (
            ["mine.py:Needs"],
            "Needs needs mass and length. Make an instance in the file, needs = Needs(mass=…, length=…), and give mine.py:needs.",
        ),
        (["mine.py:Lag", "--fmi", "1"], "invalid choice: 1 (choose from 2, 3)"),
        (
            ["mine.py:Lag", "--platform", "x86_64-linx"],
            "--platform: there is no platform 'x86_64-linx'. Did you mean 'x86_64-linux'",
        ),
        (["mine.py:Lag", "--internal-step", "0"], "--internal-step: found '0'; expected a positive number"),
        (["mine.py:Lag", "--tolerance", "nan"], "--tolerance: found 'nan'; expected a positive number"),
        (["mine.py:Lag", "--integrator", "euler"], "invalid choice: 'euler'"),
        (["mine.py:Lag", "--name", "a b"], "--name: found 'a b'; expected letters, digits and _"),
        (
            ["mine.py:Lag", "--out", "mine.py"],
            "--out: found the file 'mine.py'; expected a folder, or a file that ends in .fmu.",
        ),
        (["mine.py:Lag", "--python", "--fmi", "3"], "--fmi: found 3; an FMU with Python inside is one of FMI 2.0."),
        (["mine.py:Lag", "--python", "--no-arrays"], "--no-arrays: it can't be chosen with --python."),
        (["mine.py:Lag", "--python", "--platform", "all"], "--platform: it can't be chosen with --python."),
    ],
)
def test_wrong_usage_of_build(arguments, text, here, capsys):
    assert main(["build", *arguments]) == 2
    out, err = capsys.readouterr()
    assert text in err
    assert not out
    assert names(here) == SOURCES


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (
            "x = 1\nimport no_such_module\n",
            "in line 2: ModuleNotFoundError: No module named 'no_such_module'. Correct it",
        ),
        ("def f(:\n", "SyntaxError: invalid syntax. Correct it"),
        ("import sys\nsys.exit(3)\n", 'in line 2: SystemExit: 3. Put its script behind if __name__ == "__main__".'),
        ("import mine\nmine.nothing\n", "in line 2: AttributeError: module 'mine' has no attribute 'nothing'"),
    ],
)
def test_a_file_that_cant_be_imported(content, text, here, capsys):
    (here / "broken.py").write_text(content)
    assert main(["build", "broken.py:Lag"]) == 1
    err = capsys.readouterr().err
    assert f"{here / 'broken.py'}: importing it fails" in err
    assert text in err
    assert "mine" not in sys.modules
    assert names(here) == ["broken.py", *SOURCES]


def test_models_that_cant_be_built(here, capsys, monkeypatch):
    def fails(*arguments):
        assert main(["build", *arguments]) == 1
        out, err = capsys.readouterr()
        assert not out
        assert names(here) == SOURCES
        return err

    assert "static: found no derivative(t, x, u); expected a continuous model" in fails("mine.py:Static")
    unlucky = f"Unlucky() can't be made in line {line_of('raise RuntimeError')}: RuntimeError: no luck. Correct it."
    assert unlucky in fails("mine.py:Unlucky")
    (here / "folder").mkdir()
    with monkeypatch.context() as failing:
        fail_below(failing, here / "folder", errno.EROFS)
        assert " is on a file system that can only be read; " in fails("mine.py:Lag", "--out", "folder")
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(here / "cache"))
    monkeypatch.setenv("LOOPWRIGHT_CC", f"{shutil.which('cc') or 'cc'} -include no_such_header.h")
    err = fails("mine.py:Lag")
    assert "the C compiler failed" in err
    assert "no_such_header.h" in err  # its own message


# --- inspect --------------------------------------------------------------------------------------------------------


def test_inspect_shows_what_the_file_says(lag, capsys):
    file = lag / "lag.fmu"
    assert main(["inspect", str(file)]) == 0
    out = capsys.readouterr().out
    rows = {tuple(line.split("  ")[0].split())[:1]: line for line in out.splitlines() if line.strip()}
    assert "First-order lags: T ẏ = u − y [both]." in out
    assert hashlib.sha256(file.read_bytes()).hexdigest() in out
    for part in (
        "Loopwright",
        "co-simulation",
        "canGetAndSetFMUState",
        "providesAdjointDerivatives",
        "stop time 1.0 s",
    ):
        assert part in out
    assert "canInterpolateInputs" not in out  # what is false is not listed
    assert f"{native_platform()}: there is a binary" in out
    assert rows[("time_constant",)].split() == [
        "time_constant",
        "Float64",
        "parameter",
        "tunable",
        "s",
        "0.5",
        "time",
        "constant",
        "T",
    ]
    assert rows[("u",)].split() == ["u", "Float64", "2", "input", "continuous", "V", "0,", "0", "input", "u"]
    assert rows[("y",)].split() == [
        "y",
        "Float64",
        "2",
        "output,",
        "state",
        "continuous",
        "V",
        "1,",
        "2",
        "output",
        "y",
    ]
    assert rows[("total",)].split() == ["total", "Float64", "output", "continuous", "V", "sum"]
    assert "states         2 continuous; 0 event indicators" in out
    assert "der(y)" not in out
    assert "not shown: 1 independent, 1 local; --all shows them." in out
    assert max(map(len, out.splitlines())) <= 120
    assert main(["inspect", str(file), "--all"]) == 0
    out = capsys.readouterr().out
    assert "der(y)" in out
    assert "not shown" not in out


@pytest.mark.parametrize("name", ["lag.fmu", "lag2.fmu"])
def test_inspect_json_agrees_with_the_xml(lag, name, capsys):
    assert main(["inspect", str(lag / name), "--json"]) == 0
    text = capsys.readouterr().out
    assert text.isascii()
    found = json.loads(text, parse_constant=lambda what: pytest.fail(f"{what} is no strict JSON"))
    with zipfile.ZipFile(lag / name) as archive:
        root = etree.fromstring(archive.read("modelDescription.xml"))
        entries = archive.namelist()
    elements = {e.get("name"): e for e in root.find("ModelVariables")}
    assert [v["name"] for v in found["variables"]] == list(elements)
    for v in found["variables"]:
        element = elements[v["name"]]
        real = element if name == "lag.fmu" else element[0]
        assert v["reference"] == int(element.get("valueReference"))
        assert v["unit"] == real.get("unit")
        assert v["description"] == element.get("description", "")
        start = real.get("start")
        given = None if start is None else [float(x) for x in start.split()]
        assert v["start"] == (given[0] if given is not None and len(given) == 1 else given)
        assert v["shape"] == [int(d.get("start")) for d in element.findall("Dimension")]
    assert set(found["interfaces"]) == {k for k in _summary.INTERFACES if root.find(k) is not None}
    for kind, flags in found["interfaces"].items():
        assert {k: str(v).lower() for k, v in flags.items()} == {
            k: v.lower() for k, v in root.find(kind).attrib.items()
        }
    assert found["sources"] == sorted(e for e in entries if e.startswith("sources/"))
    assert found["documentation"] is True
    assert found["continuous_states"] == 2
    assert found["native"]["available"] is True
    assert found["native"]["missing_libraries"] == []


def test_inspect_without_a_binary_for_this_machine(altered, capsys):
    binary = f"binaries/{native_platform()}/lag.so"
    file = altered("lag.fmu", files={"binaries/riscv64-linux/lag.so": b"x"}, drop=[binary])
    assert main(["inspect", str(file)]) == 0
    out = capsys.readouterr().out
    assert "platforms      riscv64-linux\n" in out
    assert f"this machine   {native_platform()}: no binary\n" in out
    file = altered("lag.fmu", drop=[binary])
    assert main(["inspect", str(file)]) == 0
    assert "platforms      none\n" in capsys.readouterr().out


FMI1 = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="1.0" modelName="old" modelIdentifier="old" guid="{1}" numberOfContinuousStates="1"
  numberOfEventIndicators="2" generationTool="A tool of old">
  <ModelVariables>
    <ScalarVariable name="x" valueReference="1" description="a [state]"><Real start="1.5" unit="m"/></ScalarVariable>
    <ScalarVariable name="y" valueReference="2" causality="output"><Real/></ScalarVariable>
    <ScalarVariable name="on" valueReference="3" causality="input"><Boolean start="true"/></ScalarVariable>
    <ScalarVariable name="text" valueReference="3" variability="parameter"><String start="1 2"/></ScalarVariable>
  </ModelVariables>
</fmiModelDescription>
"""


def test_inspect_fmi_1(tmp_path, capsys):
    file = tmp_path / "old.fmu"
    file.write_bytes(zip_files({"modelDescription.xml": FMI1.encode(), "binaries/win32/old.dll": b"MZ"}))
    assert main(["inspect", str(file)]) == 0
    out = capsys.readouterr().out
    assert "FMI            1.0\n" in out
    assert "model exchange" in out
    assert "FMI 1.0 runs here without saved states and exact derivatives" in out
    assert "states         1 continuous; 2 event indicators" in out
    assert main(["inspect", str(file), "--json"]) == 0
    found = {v["name"]: v for v in json.loads(capsys.readouterr().out)["variables"]}
    assert (found["on"]["start"], found["text"]["start"], found["x"]["start"]) == (True, "1 2", 1.5)
    assert main(["validate", str(file)]) == 1  # no library: MZ alone is none
    out = capsys.readouterr().out
    assert "not checked: model exchange was not run: it has no binary for this machine" in out
    assert "binaries/win32/old.dll is for no platform known here: it is no shared library; expected x86-windows." in out


def test_tool_coupling_is_told(altered, capsys):
    file = altered("lag.fmu", description=lambda root: root.find("CoSimulation").set("needsExecutionTool", "true"))
    assert main(["inspect", str(file)]) == 0
    assert "It needs another program to run (needsExecutionTool)" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["inspect", "validate"])
def test_files_that_are_no_fmu(command, tmp_path, capsys):
    assert main([command, str(tmp_path / "no.fmu")]) == 2
    assert "no.fmu: there is no such file; expected an FMU. Check the path." in capsys.readouterr().err
    assert main([command, str(tmp_path)]) == 2
    assert "is a folder; expected an FMU" in capsys.readouterr().err
    assert main([command]) == 2
    capsys.readouterr()

    def says(content, text):
        file = tmp_path / "x.fmu"
        file.write_bytes(content)
        assert main([command, str(file)]) == 1
        out, err = capsys.readouterr()
        assert text in (err if command == "inspect" else out)

    says(
        b"not a zip archive",
        "is no FMU: it is no zip archive (it starts with b'not a zi')",
    )
    says(zip_files({"a.txt": b""}), "is a zip archive without modelDescription.xml, so it is no FMU. Give the .fmu")
    says(
        zip_files({"a/modelDescription.xml": b""}),
        "There is a/modelDescription.xml: pack the files in that folder, not the folder.",
    )
    says(zip_files({"modelDescription.xml": b"<a>"}), "is no XML")
    says(zip_files({"modelDescription.xml": b'<fmiModelDescription fmiVersion="9.0"/>'}), "9.0")


# --- libraries that are broken --------------------------------------------------------------------------------------


def library(folder, name, source, *more):
    """Compile a shared library; return its bytes."""
    (folder / f"{name}.c").write_text(source)
    out = folder / f"{name}.so"
    command = [shutil.which("cc") or "", "-O1", "-shared", "-fPIC"]
    if not command[0]:
        command = [*find_compiler().command, "-target", "x86_64-linux-gnu.2.17", *command[1:]]
    subprocess.run([*command, "-o", str(out), f"{name}.c", *more], cwd=folder, check=True)
    return out.read_bytes()


@pytest.mark.slow
@LINUX
def test_a_missing_shared_library_is_named(altered, tmp_path, capsys):
    library(tmp_path, "libabsent", "int absent(void) { return 1; }")
    binary = library(tmp_path, "lag", "int absent(void); int present(void) { return absent(); }", "-L.", "-labsent")
    (tmp_path / "libabsent.so").unlink()
    with pytest.raises(OSError, match="libabsent.so"):
        ctypes.CDLL(str(tmp_path / "lag.so"))
    file = altered("lag.fmu", files={"binaries/x86_64-linux/lag.so": binary})
    assert main(["inspect", str(file)]) == 0
    assert "its binary needs libraries that are missing here: libabsent.so. Install them." in capsys.readouterr().out
    assert main(["inspect", str(file), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["native"]["missing_libraries"] == ["libabsent.so"]
    assert main(["validate", str(file), "--no-run"]) == 0
    assert main(["doctor", str(file), "--no-run"]) == 1
    out = capsys.readouterr().out
    assert "a shared library that is missing here: libabsent.so" in out


@pytest.mark.slow
@LINUX
@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("load illegal", "SIGILL"),
        ("instantiate exit", "exit status 3"),
        ("load hang", "has not ended after 3 s"),
    ],
)
def test_what_crashes_or_hangs_does_so_elsewhere(tmp_path, capsys, monkeypatch, fault, says):
    file = zoo_fmu(tmp_path, 2, f"{fault} 0")
    monkeypatch.setattr(_trial, "PATIENCE", 3.0)
    assert main(["validate", str(file)]) == 1
    out = capsys.readouterr().out
    assert ". co-simulation: " in out
    assert says in out
    assert "     Next: " in out
    main(["validate", str(file), "--no-run"])
    assert says not in capsys.readouterr().out


# --- validate -------------------------------------------------------------------------------------------------------


def problems(file, capsys, *options):
    """The problems found, and their next steps."""
    code = main(["validate", str(file), *options])
    lines = capsys.readouterr().out.splitlines()
    found = [line.split(". ", 1)[1] for line in lines if line[:3] == "  " + line[2:3] and line[2:3].isdigit()]
    assert code == bool(found)
    assert len([line for line in lines if line.startswith("     Next: ")]) == len(found)
    count = {0: "clean", 1: "1 problem"}.get(len(found), f"{len(found)} problems")
    assert lines[0] == f"{file}: {count}"
    assert lines[-1].endswith(f"all the same: loopwright doctor {file}") == bool(found)
    return found


@pytest.mark.drawn(1)
@pytest.mark.parametrize("name", ["lag.fmu", "lag2.fmu"])
def test_ours_are_clean_and_run(lag, name, capsys):
    assert main(["validate", str(lag / name)]) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"{lag / name}: clean\nchecked: description against FMI ")
    assert "co-simulation run for 10 steps" in out
    assert "not checked" not in out


def test_problems_come_as_json(lag, altered, capsys):
    assert main(["validate", str(lag / "lag.fmu"), "--no-run", "--json"]) == 0
    clean = json.loads(capsys.readouterr().out)
    assert (clean["file"], clean["clean"], clean["problems"]) == (str(lag / "lag.fmu"), True, [])
    assert clean["checked"][0].startswith("description against FMI ")
    file = altered("lag.fmu", drop=["sources/model.c"])
    assert main(["validate", str(file), "--no-run", "--json"]) == 1
    (problem,) = json.loads(capsys.readouterr().out)["problems"]
    assert (
        problem["found"]
        == "sources/buildDescription.xml declares the source file model.c; there is no sources/model.c."
    )
    assert problem["next"]


def test_description_against_the_schema(altered, capsys):
    file = altered("lag.fmu", description=lambda root: root.set("madeUp", "1"))
    found = problems(file, capsys, "--no-run")
    assert any("The attribute 'madeUp' is not allowed" in text for text in found)


def test_initial_unknowns(altered, capsys):
    def drop(root):
        unknown = root.find("ModelStructure/InitialUnknown")
        unknown.getparent().remove(unknown)

    found = problems(altered("lag.fmu", description=drop), capsys, "--no-run")
    assert any("InitialUnknowns does not contain the expected set" in text for text in found)

    def double(root):
        unknown = root.find("ModelStructure/InitialUnknown")
        unknown.addnext(etree.fromstring(etree.tostring(unknown)))

    found = problems(altered("lag.fmu", description=double), capsys, "--no-run")
    assert any(text.startswith("ModelStructure lists the initial unknown with valueReference") for text in found)

    def swap(root):
        unknowns = root.find("ModelStructure/InitialUnknowns")
        unknowns[:] = list(unknowns)[::-1]

    found = problems(altered("lag2.fmu", description=swap), capsys, "--no-run")
    assert found == ["ModelStructure/InitialUnknowns is not in the order of the variables; expected ascending indices."]


def test_sources_that_are_declared(altered, capsys):
    for name, where in (("lag.fmu", "sources/buildDescription.xml"), ("lag2.fmu", "modelDescription.xml")):
        found = problems(altered(name, drop=["sources/model.c"]), capsys, "--no-run")
        assert found == [f"{where} declares the source file model.c; there is no sources/model.c."]


@LINUX
def test_binaries_and_their_folders(lag, altered, capsys):
    with zipfile.ZipFile(lag / "lag.fmu") as archive:
        binary = archive.read("binaries/x86_64-linux/lag.so")
    wrong = {"binaries/x86_64-windows/lag.dll": binary, "binaries/aarch64-darwin/other.dylib": b"x"}
    found = problems(altered("lag.fmu", files=wrong), capsys, "--no-run")
    assert len(found) == 2
    assert found[0].startswith("binaries/aarch64-darwin has no lag.dylib, needed for co-simulation")
    assert found[0].endswith("; it has other.dylib.")
    assert found[1] == "binaries/x86_64-windows/lag.dll is for x86_64-linux; expected x86_64-windows."
    assert problems(altered("lag.fmu", files={"binaries/my-own/lag.so": b""}), capsys, "--no-run") == []

    with zipfile.ZipFile(lag / "lag.fmu") as archive:
        sources = [name for name in archive.namelist() if name.startswith("sources/")]
    found = problems(altered("lag.fmu", drop=["binaries/x86_64-linux/lag.so", *sources]), capsys)
    assert found == ["it holds neither a binary nor sources, so that nothing can run it."]
    file = altered("lag.fmu", drop=["binaries/x86_64-linux/lag.so"])
    assert main(["validate", str(file)]) == 0
    assert "not checked: co-simulation was not run: it has no binary for this machine" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("header", "platforms"),
    [
        (b"\x7fELF\x02\x01" + bytes(12) + b"\x3e\x00", {"x86_64-linux"}),
        (b"\x7fELF\x02\x01" + bytes(12) + b"\xb7\x00", {"aarch64-linux"}),
        (b"\x7fELF\x02\x01" + bytes(12) + b"\x08\x00", set()),  # MIPS
        (b"MZ" + bytes(58) + b"\x40\0\0\0" + b"PE\0\0\x64\x86", {"x86_64-windows"}),
        (b"MZ" + bytes(58) + b"\x40\0\0\0" + b"NE\0\0\x64\x86", set()),
        (b"MZ" + bytes(58) + b"\xff\xff\xff\x7f", set()),
        (b"\xcf\xfa\xed\xfe\x0c\x00\x00\x01", {"aarch64-darwin"}),
        (
            b"\xca\xfe\xba\xbe\0\0\0\x02\x01\0\0\x07" + bytes(16) + b"\x01\0\0\x0c" + bytes(16),
            {"x86_64-darwin", "aarch64-darwin"},
        ),
        (b"\xca\xfe\xba\xbe\xff\xff\xff\xff", set()),
        (b"\x7fELF", set()),
        (b"", set()),
    ],
)
def test_headers_of_libraries(header, platforms):
    assert set(read_library(header).platforms) == platforms


def test_a_damaged_archive(lag, tmp_path, capsys):
    data = bytearray((lag / "lag.fmu").read_bytes())
    with zipfile.ZipFile(lag / "lag.fmu") as archive:
        start = archive.getinfo("documentation/index.html").header_offset
    data[start + 60 : start + 70] = bytes(10)
    file = tmp_path / "damaged.fmu"
    file.write_bytes(data)
    assert any("the archive is damaged" in text for text in problems(file, capsys, "--no-run"))


def test_paths_that_leave_the_folder(altered, capsys):
    found = problems(altered("lag.fmu", files={"../../escape.txt": b""}), capsys, "--no-run")
    assert len(found) == 1
    assert (
        "holds a file '../../escape.txt', which points out of the FMU's folder; expected a path within it" in found[0]
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lag.fmu", "lag2.fmu"])
def test_a_start_value_that_it_refuses(altered, name, capsys):
    """What fails is told with the FMU's own words."""

    def stop(root):
        root.set("guid" if name == "lag2.fmu" else "instantiationToken", "another")

    found = problems(altered(name, description=stop), capsys)
    assert found
    assert all("can't be loaded: Failed to instantiate" in text for text in found), found


@pytest.mark.slow
def test_terminal_without_greek(lag):
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "LC_ALL": "C"}
    command = [sys.executable, "-m", "loopwright", "inspect", str(lag / "lag.fmu")]
    result = subprocess.run(command, env=environment, capture_output=True, check=False)
    assert result.returncode == 0
    assert b"First-order lags: T ? = u - y [both]." in result.stdout


@pytest.mark.slow
def test_a_reader_that_has_had_enough(lag):
    command = [sys.executable, "-m", "loopwright", "inspect", str(lag / "lag.fmu")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert process.stderr.read() == b""
    process.stderr.close()
    assert process.wait() == 1


@pytest.mark.parametrize("command", ["build", "inspect", "validate", "doctor"])
def test_help(command, capsys):
    assert main([command, "--help"]) == 0
    out = capsys.readouterr().out
    assert out.isascii()
    assert "exit status: 0 done" in out
