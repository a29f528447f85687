"""The quick part of products of cases (`support.drawn`), a cache for each worker, and runs that tests share."""

import gc
import importlib.util
import os
import sys
from contextlib import ExitStack
from functools import cache as keep
from functools import lru_cache

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the matrices are small, and the tests run side by side

import pytest

from support.disturbed import IN_QUICK
from support.drawn import QuickAlone, find_quick

WORKER = os.environ.get("PYTEST_XDIST_WORKER", "")

# The processes of a run share bytecode, else each one compiles the rooms anew.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


def pytest_addoption(parser):
    parser.addoption("--both-tiers", action="store_true", help="compile every run as well, and compare the bits")
    text = "disturb linear algebra in all tests (0: in none); else in the tests of numbers, with seed 1"
    parser.addoption("--disturbed", type=int, metavar="SEED", help=text)
    parser.addoption("--grouped", action="store_true", help="compile every diagram block by block")
    text = "list the test functions that take more processor time, with all their cases, and the sum of each folder"
    parser.addoption("--budget", type=float, metavar="SECONDS", help=text)


def pytest_configure(config):
    if (budget := config.getoption("--budget")) is not None:
        from support.cpu_budget import Budget

        config.pluginmanager.register(Budget(budget))
    if config.option.markexpr == "not slow" and not any("::" in arg for arg in config.args):
        config.pluginmanager.register(QuickAlone(), "quick alone")


def pytest_terminal_summary(terminalreporter, config):
    if config.getoption("--both-tiers") and "support.tiers" in sys.modules:
        told = ", ".join(f"{n} {form}" for form, n in sys.modules["support.tiers"].counts.items())
        terminalreporter.write_line(f"runs in both tiers: {told}")


@pytest.fixture(scope="session")
def disturbance(cache, tmp_path_factory):
    """Linear algebra that can be disturbed, see `support.disturbed`."""
    from support.disturbed import Disturbance

    with pytest.MonkeyPatch.context() as patch:
        found = Disturbance(tmp_path_factory.mktemp("disturbed"))
        found.install(patch)
        yield found


@pytest.fixture(autouse=True)
def as_asked(request):
    """Do what the options ask of each test, and close the figures that it has shown, which pyplot keeps.

    This is one fixture, as it runs for every test: four took a millisecond. ``--both-tiers``, or the mark: every run is
    compiled as well. ``--disturbed``: linear algebra is disturbed in all tests by that seed, else in most of those of
    numbers by seed 1. ``--grouped``: every diagram is taken for a large one.
    """
    marks, asked = {mark.name for mark in request.node.iter_markers()}, request.config.option
    seed = request.node.nodeid.startswith(IN_QUICK) if asked.disturbed is None else asked.disturbed
    with ExitStack() as during:
        if (asked.both_tiers or "both_tiers" in marks) and "one_tier" not in marks:
            from support import tiers

            tiers.install(during.enter_context(pytest.MonkeyPatch.context()))
        if seed and "equal_bits" not in marks:
            during.enter_context(request.getfixturevalue("disturbance").on(int(seed)))
        if asked.grouped:
            patch = during.enter_context(pytest.MonkeyPatch.context())
            patch.setattr("loopwright.diagrams.flat.flat_diagram.LARGEST", 0)
        yield
    if pyplot := sys.modules.get("matplotlib.pyplot"):
        pyplot.close("all")


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """Read the folders backwards in every other worker: each takes what another has compiled before it came there."""
    report = yield
    if isinstance(collector, pytest.Dir) and WORKER[-1:] in set("13579"):
        report.result = report.result[::-1]
    return report


@pytest.hookimpl(wrapper=True)
def pytest_pycollect_makeitem(collector, name, obj):
    """Mark the cases of a function that aren't quick as slow, see `support.drawn.find_quick`."""
    items = yield
    group = [item for item in items if isinstance(item, pytest.Function)] if isinstance(items, list) else []
    if len(group) < 2 or collector.config.pluginmanager.has_plugin("quick alone"):
        return items
    chosen = any(item.get_closest_marker("slow") for item in group)
    quick = {*find_quick(group[0], [item.callspec.params for item in group], chosen=chosen)}
    for i, item in enumerate(group):
        if i not in quick:
            item.add_marker(pytest.mark.slow)
    return items


@pytest.hookimpl(optionalhook=True)  # the tests run without xdist, too
def pytest_xdist_make_scheduler(config, log):
    """Give each file to one worker, so that what its tests share is made once; the longest first.

    Few workers take all files on FMUs as one, since they share builds; two files share the trees of all sources.
    """
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid):
            exported = nodeid.startswith("tests/fmus/") and self.numnodes <= 3
            if exported:
                return "tests/fmus"
            if nodeid.startswith(("tests/test_architecture.py", "tests/test_house.py")):
                return "tests/test_architecture.py"
            return nodeid if nodeid.startswith("tests/test_other_machines.py") else super()._split_scope(nodeid)

    config.option.loadscopereorder = False
    return Scheduling(config, log)


def pytest_collection_modifyitems(items):
    """Sort by file, so that all workers have one order; before the others those that take longest."""
    longest = ("tests/test_project.py", "tests/fmus/", "tests/test_pages.py")

    @keep
    def place(file):
        return next((i for i, name in enumerate(longest) if file.startswith(name)), len(longest)), file

    items.sort(key=lambda item: place(item.nodeid.partition("::")[0]))


def pytest_collection(session):
    """Collect no garbage while the tests are imported: a fifth of the time, and nearly all of it stays."""
    gc.disable()


def pytest_collection_finish(session):
    """Collect garbage less often, and never what the collection of the tests has made: a tenth of the set's time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)
    gc.enable()


def pytest_unconfigure(config):
    """Let the end of the process collect all, as libraries that count their objects expect."""
    gc.unfreeze()


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory):
    """Folder of this worker's cache. The compiler's own, 50 MB that are the same for all, is shared by the workers.

    So are compiled libraries, which stay in this user's cache folder for all checkouts (`support.kept_libraries`).
    """
    from support import kept_libraries
    from support.kept import kept_folder

    folder = tmp_path_factory.mktemp("cache")
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if WORKER else base
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LOOPWRIGHT_CACHE", str(folder))
        patch.setenv("ZIG_GLOBAL_CACHE_DIR", str(shared / "zig"))
        patch.setenv("ZIG_LOCAL_CACHE_DIR", str(shared / "zig"))
        patch.delenv("LOOPWRIGHT_CC", raising=False)
        kept = kept_folder("compiled") if importlib.util.find_spec("ziglang") is not None else None
        if kept is not None:
            kept_libraries.install(patch, kept, shared / "zig")
        yield folder


@pytest.fixture(scope="module")
def processes_of_earlier_tests_ended():
    """End FMUs that earlier files left in circles of references, such as an exception in a variable of its frame."""
    from loopwright.fmus.isolation import end_idle

    gc.collect()
    end_idle()


@pytest.fixture
def no_process_left(processes_of_earlier_tests_ended):
    """The test leaves no process of an FMU behind."""
    from loopwright.fmus.isolation import count_processes, end_idle

    yield
    end_idle()
    assert count_processes() == (0, 0)


@pytest.fixture
def uncompiled(tmp_path_factory, monkeypatch):
    """Builds have an empty file as their binary, in a cache of their own: for tests of what else is in the file."""
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path_factory.mktemp("uncompiled")))
    monkeypatch.setattr(
        "loopwright.fmus.export.fmu_package.compile_shared", lambda sources, out, **options: out.touch()
    )


@pytest.fixture
def meeting(tmp_path, monkeypatch):
    """A `support.waiting.Meeting` that FMUs find whose processes start in this test."""
    from support.waiting import Meeting

    return Meeting(tmp_path, monkeypatch)


@pytest.fixture
def undrawn(monkeypatch):
    """Figures are empty files: for runs of which the files are counted and no figure is looked at."""

    def save(figure, stem):
        files = stem.with_name(stem.name + ".png"), stem.with_name(stem.name + ".svg")
        for file in files:
            file.touch()
        return files

    for name in ("plot_path", "plot_experiment"):
        monkeypatch.setattr(f"loopwright.diagrams.paper.{name}", lambda *_, **__: None)
    monkeypatch.setattr("loopwright.diagrams.plotting.save", save)


@pytest.fixture(scope="session")
def runs():
    """runs(letter, **options) -> (experiment, run)."""
    from loopwright.diagrams import experiments

    @lru_cache(maxsize=16)  # a run holds some 10 MB
    def run(letter, **options):
        experiment = experiments.EXPERIMENTS[letter](**options)
        return experiment, experiment.simulate(progress=False)

    return run


@pytest.fixture(scope="session")
def solutions():
    """solutions(letter, **options) -> arrays by name, by the independent solution of `oracle`."""
    from support import oracle

    @keep
    def solve(letter, **options):
        return oracle.simulate(letter, oracle.Options(**options))

    return solve
