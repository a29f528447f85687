"""The quick part of products of cases (`support.drawn`), a cache for each worker, and runs that tests share."""

import os
from collections import defaultdict
from functools import cache as keep
from functools import lru_cache

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the matrices are small, and the tests run side by side

import pytest

from loopwright.diagrams import experiments
from support import oracle
from support.drawn import draw, identify


@pytest.hookimpl(wrapper=True)
def pytest_pycollect_makeitem(collector, name, obj):
    items = yield
    cases = defaultdict(list)
    for item in items if isinstance(items, list) else ():
        if isinstance(item, pytest.Function) and (mark := item.get_closest_marker("drawn")):
            cases[item.originalname, mark.args].append(item)
    for (_, args), group in cases.items():
        quick = draw([identify(item) for item in group], *args)
        for i, item in enumerate(group):
            if i not in quick:
                item.add_marker(pytest.mark.slow)
    return items


def pytest_xdist_make_scheduler(config, log):
    """Give each file to one worker, so that what its tests share is made once; the longest file first."""
    from xdist.scheduler import LoadFileScheduling

    config.option.loadscopereorder = False
    return LoadFileScheduling(config, log)


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: item.path.name != "test_project.py")


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory):
    """Folder of this worker's cache. The compiler's own, 50 MB that are the same for all, is shared by the workers."""
    folder = tmp_path_factory.mktemp("cache")
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LOOPWRIGHT_CACHE", str(folder))
        patch.setenv("ZIG_GLOBAL_CACHE_DIR", str(shared / "zig"))
        patch.setenv("ZIG_LOCAL_CACHE_DIR", str(shared / "zig"))
        patch.delenv("LOOPWRIGHT_CC", raising=False)
        yield folder


@pytest.fixture(scope="session")
def runs():
    """runs(letter, **options) -> (experiment, run)."""

    @lru_cache(maxsize=16)  # a run holds some 10 MB
    def run(letter, **options):
        experiment = experiments.EXPERIMENTS[letter](**options)
        return experiment, experiment.simulate(progress=False)

    return run


@pytest.fixture(scope="session")
def solutions():
    """solutions(letter, **options) -> arrays by name, by the independent solution of `oracle`."""

    @keep
    def solve(letter, **options):
        return oracle.simulate(letter, oracle.Options(**options))

    return solve
