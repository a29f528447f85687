"""Random linear diagrams with continuous states and several clocks in C: the matrix exponential."""

import numpy as np
import pytest
from hypothesis import assume

from support.random_cases import random_cases
from support.random_linear import BASE, PERIOD, Matrices, diagram, specs


def check(spec, solver, tolerance):
    """Hold a compiled run against the matrix exponential; see tests/diagrams/flat/test_random_diagrams.py."""
    for _ in range(12):
        oracle = Matrices(spec)
        if oracle.growth() < 2.0:
            break
        spec = spec.scaled(0.5)
    else:
        assume(False)
    ticks, expected = oracle.run(PERIOD)
    run = diagram(spec).simulate(
        PERIOD * BASE,
        step=BASE if oracle.quiet else None,
        solver=solver,
        rtol=tolerance,
        atol=0.1 * tolerance,
        compile=True,
        progress=False,
    )
    assert not any(message.startswith("Interpreted") for message in run.messages)
    rows = np.searchsorted(run.t, np.array(ticks) / 100)
    assert np.array_equal(run.t[rows], np.array(ticks) / 100)
    found = np.hstack([np.reshape(run[f"b{i}.y"], (len(run.t), -1)) for i in range(len(spec.nodes))])[rows]
    assert np.max(np.abs(found - expected)) < 100 * tolerance * max(1.0, np.max(np.abs(expected)))


@random_cases(2, 20, specs(least=12), fresh=True)
def test_random_hybrid_diagrams_are_the_matrix_exponential(spec):
    check(spec, "DOP853", 1e-12)


@pytest.mark.slow
@random_cases(3, 10, specs(least=12))
def test_random_hybrid_diagrams_are_the_matrix_exponential_by_radau(spec):
    check(spec, "Radau", 1e-9)


@pytest.mark.slow
@random_cases(3, 10, specs(least=12, clocked=False))
def test_random_continuous_diagrams_are_the_matrix_exponential(spec):
    check(spec, "RK45", 1e-9)
