"""Random linear diagrams: nested, flattened, and the matrix exponential; any order of definition."""

import numpy as np
import pytest
from hypothesis import assume
from hypothesis import strategies as st

from loopwright.blocks import Sine, TransferFunction
from loopwright.diagrams import Diagram
from support.random_cases import random_cases
from support.random_linear import BASE, PERIOD, Matrices, diagram, specs

LAST = 2 * PERIOD
TIGHT = {"solver": "DOP853", "rtol": 1e-12, "atol": 1e-13, "progress": False}


def bounded(spec):
    """Return the diagram with gains so small that no mode more than doubles while all clocks come round, 0.3 s."""
    for _ in range(12):
        oracle = Matrices(spec)
        if oracle.growth() < 2.0:
            return spec, oracle
        spec = spec.scaled(0.5)
    assume(False)
    return None


def outputs(run, count):
    return np.hstack([np.reshape(run[f"b{i}.y"], (len(run.t), -1)) for i in range(count)])


def simulate(made, oracle):
    return made.simulate(LAST * BASE, step=BASE if oracle.quiet else None, **TIGHT)


def check(spec):
    spec, oracle = bounded(spec)
    ticks, expected = oracle.run(LAST)
    largest = max(1.0, np.max(np.abs(expected)))
    worst = 0.0
    for variant in (diagram(spec), diagram(spec, borders=False), diagram(spec.flattened())):
        run = simulate(variant, oracle)
        rows = np.searchsorted(run.t, np.array(ticks) / 100)
        assert np.array_equal(run.t[rows], np.array(ticks) / 100)  # and those of boxes without blocks, which tick, too
        worst = max(worst, np.max(np.abs(outputs(run, len(spec.nodes))[rows] - expected)) / largest)
    assert worst < 1e-10
    return worst


@random_cases(3, 200, specs(least=12), fresh=True)
def test_nested_flattened_and_matrix_exponential_agree(spec):
    check(spec)


@pytest.mark.slow
@random_cases(3, 40, specs(least=12, clocked=False))
def test_without_any_clock_it_is_one_matrix_exponential(spec):
    check(spec)


@random_cases(3, 40, specs(least=12, continuous=False))
def test_without_anything_continuous_it_is_a_product_of_matrices(spec):
    check(spec)


@random_cases(3, 40, specs(least=12), st.integers(0, 2**32 - 1))
def test_shuffled_definitions_give_the_same_bits(spec, seed):
    spec, oracle = bounded(spec)
    order = np.random.default_rng(seed)
    first, second = (simulate(diagram(spec, o), oracle) for o in (None, order))
    assert first.names == second.names
    assert first.layout.slices == second.layout.slices
    assert first.data.tobytes() == second.data.tobytes()


@random_cases(None, 200, specs(), fresh=True)
def test_nested_flattened_and_matrix_exponential_agree_in_diagrams_of_any_size(spec):
    check(spec)


def test_samples_within_a_step_are_as_exact_as_its_ends():
    # a step of DOP853 may be exact by luck where its dense output, of lower order, is not: 9e-10 of the signal here
    sine = Sine(frequency=1.614943597312375, phase=4.14299055309732)
    lag = TransferFunction(numerator=[-0.23419445], denominator=[1.0, 1.0, 4.82929417], name="lag")
    made = Diagram("d", lag(sine)).simulate(0.6, step=0.01, **TIGHT)
    short = Diagram("d", lag(sine)).simulate(0.6, step=0.01, max_step=1e-3, **TIGHT)
    assert np.abs(made["lag.y"] - short["lag.y"]).max() < 1e-13
