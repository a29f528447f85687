"""The house itself: walls between rooms, public names, lint, types, the wheel, the README's code, the notebooks."""

import ast
import doctest
import importlib
import importlib.metadata
import inspect
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
import zipfile
from contextlib import chdir
from pathlib import Path
from xml.etree import ElementTree as ET

import matplotlib
import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

import loopwright.blocks
import loopwright.diagrams
import loopwright.fmus

ROOT = Path(__file__).parent.parent
ROOMS = {"blocks": set(), "fmus": {"blocks"}, "diagrams": {"blocks", "fmus"}}
SOURCES = sorted(p for room in ROOMS for p in (ROOT / room).rglob("*.py"))


def call(*arguments, **options):
    return subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, check=False, **options)


@pytest.mark.parametrize("room", ROOMS)
def test_everything_public_is_exported_on_purpose_and_documented(room):
    module = importlib.import_module(f"loopwright.{room}")
    assert module.__all__ == sorted(module.__all__)
    public = {n for n, v in vars(module).items() if not n.startswith("_") and not inspect.ismodule(v)}
    assert public - {"annotations"} == {n for n in module.__all__ if not inspect.ismodule(getattr(module, n))}
    for name in module.__all__:
        assert inspect.getdoc(getattr(module, name)) or name == "Array", f"{room}.{name} has no docstring"


def test_every_parameter_of_a_block_is_described_and_has_bounds_or_a_unit_where_it_is_physical():
    for name in loopwright.blocks.__all__:
        cls = getattr(loopwright.blocks, name)
        if inspect.isclass(cls) and issubclass(cls, loopwright.blocks.Value):
            for parameter, spec in cls.parameter_specs.items():
                assert spec.description, f"{name}.{parameter} has no description"


@pytest.mark.parametrize("arguments", [["check", "."], ["format", "--check", "."]], ids=["lint", "format"])
def test_ruff(arguments):
    done = call(sys.executable, "-m", "ruff", *arguments)
    assert done.returncode == 0, done.stdout + done.stderr


def test_types(tmp_path):
    (tmp_path / "loopwright").mkdir()
    for room in ROOMS:
        (tmp_path / "loopwright" / room).symlink_to(ROOT / room)
    packages = [argument for room in ROOMS for argument in ("-p", f"loopwright.{room}")]
    environment = {**os.environ, "MYPYPATH": str(tmp_path)}
    done = call(sys.executable, "-m", "mypy", *packages, "--cache-dir", str(tmp_path / "cache"), env=environment)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_subpackage_is_listed_for_the_wheel():
    setup = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    folders = {str(p.parent.relative_to(ROOT)).replace(os.sep, ".") for p in SOURCES}
    assert {f"loopwright.{f}" for f in folders} == set(setup["packages"])
    assert importlib.metadata.version("loopwright")


def test_every_file_that_is_no_code_is_listed_for_the_wheel():
    setup = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    listed = {
        file
        for package, patterns in setup["package-data"].items()
        for pattern in patterns
        for file in (ROOT / package.removeprefix("loopwright.").replace(".", os.sep)).glob(pattern)
    }
    kept = call("git", "ls-files", *ROOMS).stdout.splitlines()
    assert {ROOT / name for name in kept if not name.endswith(".py")} == listed


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted((ROOT / "benchmarks").glob("*.py")), ids=lambda path: path.stem)
def test_the_benchmarks_run(path):
    done = call(sys.executable, str(path))  # what they measure is for people: no time is asserted
    assert done.returncode == 0, done.stdout + done.stderr
    assert any(line.strip() for line in done.stdout.splitlines())


@pytest.mark.slow
def test_the_built_wheel_imports_runs_and_holds_the_c_runtime(tmp_path):
    copy = tmp_path / "source"
    assert call("git", "clone", "-q", str(ROOT), str(copy)).returncode == 0
    done = call(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(tmp_path), str(copy))
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    site = tmp_path / "site"
    done = call(sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", str(site), str(wheel))
    assert done.returncode == 0, done.stdout + done.stderr
    script = (
        "import loopwright.blocks, loopwright.fmus, loopwright.diagrams as d, sys; "
        f"assert d.__file__.startswith({str(site)!r}), d.__file__; "
        "run = d.experiments.path_following().diagram.simulate(0.1, progress=False); print(run['eta'][0, 0]); "
        "from loopwright.blocks import Constant, Integrator; "
        "d.Diagram('small', Integrator()(Constant(value=1.0))).report('small.html')"
    )
    environment = {**os.environ, "PYTHONPATH": str(site), "LOOPWRIGHT_CACHE": str(tmp_path / "cache")}
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == pytest.approx(0.1, abs=1e-12)
    assert "Design report: small" in (tmp_path / "small.html").read_text(encoding="utf-8")
    for room in ROOMS:
        assert (site / "loopwright" / room / "py.typed").is_file()


def test_importing_changes_no_global_state():
    script = """
import sys, warnings, numpy, casadi, matplotlib
def state():
    return (list(warnings.filters), numpy.geterr(), numpy.get_printoptions(), {k: matplotlib.rcParams[k] for k in matplotlib.rcParams if k != "backend"},
            [getattr(casadi, n, None) for n in ("GlobalOptions",)], casadi.GlobalOptions.getMaxNumDir())
before = state()
import loopwright.blocks, loopwright.fmus, loopwright.diagrams
loopwright.diagrams.experiments.path_following().diagram.simulate(0.01, progress=False)
assert state() == before
late = [m for m in ("control", "matplotlib.pyplot", "scipy.integrate") if m in sys.modules]
assert not late, late
"""
    done = call(sys.executable, "-c", script)
    assert done.returncode == 0, done.stderr


def blocks_of_code(text):
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


def run_commands(text, folder):
    """Run the lines of a page's shell code that are commands of an installed package."""
    lines = [line for part in re.findall(r"```sh\n(.*?)```", text, re.DOTALL) for line in part.splitlines()]
    commands = [shlex.split(line, comments=True) for line in lines if line.startswith(("loopwright ", "fmpy "))]
    assert len(commands) >= 3
    for program, *arguments in commands:
        found = shutil.which(program, path=os.path.dirname(sys.executable))
        done = subprocess.run(
            [found, *arguments], cwd=folder, capture_output=True, text=True, check=False, env=os.environ
        )
        assert done.returncode == 0, f"{program} {arguments}: {done.stdout}{done.stderr}"


def test_the_readme_opens_with_a_closed_loop_in_ten_lines_that_runs(tmp_path):
    first, *more = blocks_of_code((ROOT / "README.md").read_text(encoding="utf-8"))
    lines = [line for line in first.splitlines() if line.strip()]
    assert len(lines) <= 10
    (tmp_path / "loop.py").write_text(first, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "loop.py"], cwd=tmp_path, capture_output=True, text=True, check=False, env=os.environ
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "loop.png").read_bytes().startswith(b"\x89PNG")
    scope = {}
    with chdir(tmp_path):
        exec(first, scope)
        assert isinstance(scope["run"].plot("position"), matplotlib.figure.Figure)  # which a notebook shows
        for snippet in more:
            exec(snippet, scope)
    run_commands((ROOT / "README.md").read_text(encoding="utf-8"), tmp_path)


def test_the_page_on_diagrams_runs(tmp_path):
    scope = {}
    with chdir(tmp_path):
        for snippet in blocks_of_code((ROOT / "docs" / "diagrams.md").read_text(encoding="utf-8")):
            exec(snippet, scope)


def as_in_a_table(value):
    return "–" if np.isnan(value) else "∞" if np.isinf(value) else f"{value:.6g}"


def test_the_page_on_frequencies_runs_and_its_numbers_are_those_it_gives(tmp_path):
    text, scope = (ROOT / "docs" / "frequency.md").read_text(encoding="utf-8"), {}
    with chdir(tmp_path):
        for snippet in blocks_of_code(text):
            exec(snippet, scope)
    for name, cells in re.findall(r"^\| `([\w.]+)` \|(.*)\|$", text, re.MULTILINE):
        told = [c.strip() for c in re.split(r"(?<!\\)\|", cells)]
        if name in scope["limits"]:
            limit = scope["limits"][name]
            assert told == [as_in_a_table(limit.value), as_in_a_table(limit.rule_of_thumb)], name
        else:
            made = [
                getattr(scope["disks" if hasattr(scope["disks"][v], name) else "found"][v], name)
                for v in ("continuous", "sampled_d0", "sampled_d1")
            ]
            assert told[-3:] == [as_in_a_table(float(v)) for v in made], name
    assert f"here {scope['sign'].frequency:.3f} rad/s" in text


def test_the_page_on_export_runs(tmp_path):
    text = (ROOT / "docs" / "export.md").read_text(encoding="utf-8")
    model, *more = blocks_of_code(text)
    (tmp_path / "thermostat.py").write_text(model, encoding="utf-8")
    (tmp_path / "page.py").write_text("\n".join(more), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "page.py"], cwd=tmp_path, capture_output=True, text=True, check=False, env=os.environ
    )
    assert done.returncode == 0, done.stderr
    run_commands(text, tmp_path)


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("model", ["gantry", "bouncing_ball"])
def test_the_page_on_export_tells_the_flags_as_they_are(fmi, model, tmp_path):
    path = getattr(loopwright.fmus, model).build(out=tmp_path, fmi=fmi)
    with zipfile.ZipFile(path) as archive:
        tree = ET.fromstring(archive.read("modelDescription.xml"))
    text = (ROOT / "docs" / "export.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)`(?: \(2\.0: `(\w+)`\))? \|(.*)\|$", text.split("## Integrators")[0], re.MULTILINE)
    with_events = "true" if model == "bouncing_ball" else "false"
    spelling = {"canGetAndSetFMUState": "canGetAndSetFMUstate", "canSerializeFMUState": "canSerializeFMUstate",
                "providesDirectionalDerivatives": "providesDirectionalDerivative"}  # fmt: skip
    for column, interface in enumerate(("CoSimulation", "ModelExchange"), 0 if fmi == 3 else 2):
        told = {}
        for name, name2, cells in rows:
            cell = [c.strip() for c in cells.split("|")][column]
            if cell != "–":
                key = name if fmi == 3 else name2 or spelling.get(name, name)
                told[key] = with_events if cell == "with events" else cell
        attributes = dict(tree.find(interface).attrib)
        del attributes["modelIdentifier"]
        assert told == attributes, interface


def test_the_notebooks_run():
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(path.parent)}}).execute()
        shown = [o for cell in notebook.cells for o in cell.get("outputs", [])]
        assert any("image/png" in o.get("data", {}) for o in shown), path


def test_doctests():
    results = []
    for path in SOURCES:
        name = ".".join(("loopwright", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__")
        if not name.endswith("__main__"):
            results.append(doctest.testmod(importlib.import_module(name)))
    assert sum(r.failed for r in results) == 0
    assert sum(r.attempted for r in results) >= 5


# --- the paper's equations ----------------------------------------------------------------------------------------------

CARRIERS = {  # who makes an equation of the paper what it is
    "PlanarModel": (1, 3),
    "Gantry": (1, 3),
    "PathTracking": (4, 6),
    "PathProjection": (4, 6),
    "TransverseTransform": (3, 5, 7),
    "FeedbackLinearization": (9, 10, 11),
    "ErrorDynamics": (12,),
    "ForceProjection": (13,),
    "AdmittanceFilter": (14, 15),
    "Ellipse": (16,),
}


def docstrings():
    """Yield the name of every module, class and function of blocks and fmus, and what is written under it."""
    for path in SOURCES:
        if path.relative_to(ROOT).parts[0] in ("blocks", "fmus"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                    yield getattr(node, "name", path.stem), ast.get_docstring(node) or ""


@pytest.mark.parametrize("number", range(1, 17))
def test_every_equation_of_the_paper_stands_in_a_docstring(number):
    assert [name for name, text in docstrings() if f"({number})" in text]


@pytest.mark.parametrize("carrier", CARRIERS)
def test_whoever_makes_an_equation_says_its_number(carrier):
    (text,) = [text for name, text in docstrings() if name == carrier]
    assert not [n for n in CARRIERS[carrier] if f"({n})" not in text]
