"""Runs of the experiments and their independent solutions, each made once."""

import os
from functools import cache, lru_cache

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the matrices are small, and the tests run side by side

import pytest

from loopwright.diagrams import experiments
from support import oracle


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

    @cache
    def solve(letter, **options):
        return oracle.simulate(letter, oracle.Options(**options))

    return solve
