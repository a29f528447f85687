"""The project itself: walls between packages, public names, lint, types, the wheel, doctests."""

import doctest
import importlib
import importlib.metadata
import inspect
import os
import subprocess
import sys
import tomllib
import warnings
from contextlib import nullcontext
from pathlib import Path

import pytest

import loopwright
from support.kept import kept_folder, kept_tree

ROOT = Path(__file__).parent.parent
FOLDERS = {"front": "loopwright", **{name: f"loopwright.{name}" for name in ("blocks", "fmus", "diagrams")}}
PUBLIC = (
    "loopwright",
    *(f"loopwright.{name}" for name in ("blocks", "fmus", "diagrams", "frequency", "sweeps", "types")),
)
SOURCES = sorted(p for folder in FOLDERS for p in (ROOT / folder).rglob("*.py"))


def module_of(path):
    """Return the name by which a source is imported."""
    folder, *inner = path.relative_to(ROOT).with_suffix("").parts
    return ".".join((FOLDERS[folder], *inner)).removesuffix(".__init__")


def call(*arguments, **options):
    return subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, check=False, **options)


@pytest.mark.parametrize("name", PUBLIC)
def test_everything_public_is_exported_on_purpose_and_documented(name):
    module = importlib.import_module(name)
    assert module.__all__ == sorted(module.__all__)
    public = {n for n, v in vars(module).items() if not n.startswith("_") and not inspect.ismodule(v)}
    assert public - {"annotations"} <= set(module.__all__) == set(dir(module))
    for public in module.__all__:
        documented = inspect.getdoc(getattr(module, public)) or public in ("Array", "__version__")
        assert documented, f"{name}.{public} has no docstring"


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


@pytest.mark.parametrize(
    ("module", "error"),
    [
        ("control.statesp", nullcontext()),
        ("numpy.lib", nullcontext()),
        ("distributed.utils", nullcontext()),
        ("loopwright.diagrams.frequency.loop_margins", pytest.raises(DeprecationWarning)),
        ("support.linear", pytest.raises(DeprecationWarning)),
        ("tests.blocks.test_a", pytest.raises(DeprecationWarning)),
        ("__main__", pytest.raises(DeprecationWarning)),
        ("<string>", pytest.raises(DeprecationWarning)),  # the code of pages, which tests run with exec
    ],
)
def test_deprecations_are_errors_where_our_code_or_a_users_causes_them(module, error):
    for kind in (DeprecationWarning, type("DeprecatedSince", (DeprecationWarning,), {})):
        with error:
            warnings.warn_explicit("goes in version 3", kind, "file.py", 1, module=module)
    with pytest.raises(FutureWarning):  # which Python shows wherever it comes from
        warnings.warn_explicit("changes in version 3", FutureWarning, "file.py", 1, module=module)


def test_types(tmp_path):
    """Mypy's cache stays for all checkouts: an entry counts only for the file's very content, wherever it is."""
    (tmp_path / "loopwright").mkdir()
    for file in (ROOT / "front").iterdir():
        (tmp_path / "loopwright" / file.name).symlink_to(file)
    for folder in FOLDERS.keys() - {"front"}:
        (tmp_path / "loopwright" / folder).symlink_to(ROOT / folder)
    environment = {**os.environ, "MYPYPATH": str(tmp_path)}
    here = ".".join(map(str, sys.version_info[:2]))  # NumPy's stubs may need it, where it is newer than the lowest
    kept = kept_folder("types")
    archive = kept and kept / f"mypy-{importlib.metadata.version('mypy')}-python-{here}.tar"
    with kept_tree(archive, tmp_path / "cache") as cache:
        options = ("--python-version", here, "--cache-dir", str(cache))
        done = call(sys.executable, "-m", "mypy", "-p", "loopwright", *options, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_subpackage_is_listed_for_the_wheel():
    setup = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    assert {module_of(path.parent / "__init__.py") for path in SOURCES} == set(setup["packages"])
    assert setup["package-dir"] == {package: folder for folder, package in FOLDERS.items()}
    assert importlib.metadata.version("loopwright")


def test_the_root_holds_what_belongs_there():
    kept = call("git", "ls-files").stdout.splitlines()
    assert {path for path in kept if "/" not in path} == {
        ".gitignore",
        "CHANGELOG.md",
        "CITATION.cff",
        "CONTRIBUTING.md",
        "LICENSE",
        "MANIFEST.in",
        "README.md",
        "pyproject.toml",
    }
    assert {path.partition("/")[0] for path in kept if "/" in path} == {
        ".ci",
        "benchmarks",
        "blocks",
        "diagrams",
        "docs",
        "fmus",
        "front",
        "install",
        "notebooks",
        "tests",
    }


def test_every_file_that_is_no_code_is_listed_for_the_wheel():
    setup = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    folders = {module_of(path.parent / "__init__.py"): path.parent for path in SOURCES}
    listed = {
        file
        for package, patterns in setup["package-data"].items()
        for pattern in patterns
        for file in folders[package].glob(pattern)
    }
    kept = call("git", "ls-files", *FOLDERS).stdout.splitlines()
    made = {file for file in listed if file.parent.name == "built"}  # by the installation
    assert {ROOT / name for name in kept if not name.endswith(".py")} == listed - made


BENCHMARKS = sorted((ROOT / "benchmarks").glob("*.py"))


def test_the_benchmarks_find_what_they_import():
    # none is __main__, so nothing is timed; they import each other
    script = "import runpy, sys; sys.path.insert(0, sys.argv[1]); [runpy.run_path(path) for path in sys.argv[2:]]"
    done = call(sys.executable, "-c", script, str(ROOT / "benchmarks"), *map(str, BENCHMARKS))
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("path", BENCHMARKS, ids=lambda path: path.stem)
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
        "import loopwright as lw; "
        f"assert lw.__file__.startswith({str(site)!r}), lw.__file__; "
        "run = lw.experiments.path_following().diagram.simulate(0.1, progress=False); print(run['eta'][0, 0]); "
        "from loopwright.blocks import Constant, Integrator; "
        "lw.Diagram('small', Integrator()(Constant(value=1.0))).report('small.html')"
    )
    (runtime,) = (site / "loopwright" / "fmus" / "runtime" / "built").iterdir()
    assert "none-any" not in wheel.name, runtime
    environment = {**os.environ, "PYTHONPATH": str(site), "LOOPWRIGHT_CACHE": str(tmp_path / "cache")}
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == pytest.approx(0.1, abs=1e-12)
    assert "Design report: small" in (tmp_path / "small.html").read_text(encoding="utf-8")
    assert (site / "loopwright" / "py.typed").is_file()
    command = (sys.executable, "-m", "loopwright", "--version")
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["loopwright", loopwright.__version__], done.stderr


@pytest.mark.slow
def test_an_installation_without_a_compiler_is_a_pure_wheel(tmp_path):
    copy = tmp_path / "source"
    assert call("git", "clone", "-q", str(ROOT), str(copy)).returncode == 0
    command = (sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(tmp_path), str(copy))
    done = call(*command, env={**os.environ, "LOOPWRIGHT_CC": "no-such-compiler"})
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name.endswith("-py3-none-any.whl")


def test_importing_changes_no_global_state():
    script = """
import pickle, sys, warnings, numpy, casadi, matplotlib
def state():
    return (list(warnings.filters), numpy.geterr(), numpy.get_printoptions(), {k: matplotlib.rcParams[k] for k in matplotlib.rcParams if k != "backend"},
            [getattr(casadi, n, None) for n in ("GlobalOptions",)], casadi.GlobalOptions.getMaxNumDir())
before = state()
try:
    pickle.loads(b"cloopwright.diagrams.fig3\\nChannel\\n.")
except ModuleNotFoundError as error:
    assert "before 0.2.0" in str(error)  # before anything else is loaded
import loopwright
assert "loopwright.blocks.core" not in sys.modules  # a name is loaded when it is used
wave = loopwright.blocks.Sine(frequency=1.0)()
loopwright.Diagram("wave", wave).simulate(1.0, step=0.5, progress=False)
needed = {"compiled", "coupling", "diagram", "flat", "model_exchange", "results", "simulation", "solvers", "wiring"}  # a run pays for nothing else
assert {m.split(".")[2] for m in sys.modules if m.startswith("loopwright.diagrams.")} == needed
loopwright.experiments.path_following().diagram.simulate(0.01, progress=False)
late = [m for m in ("control", "matplotlib.pyplot", "scipy.integrate") if m in sys.modules]
assert not late, late
for package in (loopwright, loopwright.blocks, loopwright.fmus, loopwright.diagrams, loopwright.frequency, loopwright.sweeps, loopwright.types):
    assert all(hasattr(package, name) for name in package.__all__)
assert state() == before
"""
    done = call(sys.executable, "-c", script)
    assert done.returncode == 0, done.stderr


def test_doctests(monkeypatch):
    monkeypatch.setattr("linecache.checkcache", lambda filename=None: None)  # for each docstring it looks for all files
    results = []
    for path in SOURCES:
        name = module_of(path)
        if not name.endswith("__main__"):
            results.append(doctest.testmod(importlib.import_module(name)))
    assert sum(r.failed for r in results) == 0
    assert sum(r.attempted for r in results) >= 5
