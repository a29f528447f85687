"""Linear continuous blocks in sampled subsystems: exact against the matrix exponential, Euler's methods by hand."""

import casadi as ca
import mpmath
import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks.tracing.discretization import hold_of_symbols
from loopwright.blocks.tracing.symbols import wrap
from loopwright.diagrams import Diagram, subsystem
from support.sampled import TICKS, T, Wave, network, run_of, wave

EULER = pytest.mark.parametrize("method", ["forward", "semi_implicit"])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("sample_time", [0.001, 0.05, 0.4])
def test_a_linear_block_is_exact_between_held_inputs(seed, sample_time):
    block = network(seed).replace(name="n")
    run = run_of(block, Wave()(), sample_time=sample_time)
    x, rows, n = block.start, [], len(block.g)
    for k in range(TICKS + 1):
        rows.append(x)
        drive = (block.B @ wave(k * sample_time) + block.g)[:, None]
        x = (expm(np.block([[block.A, drive], [np.zeros((1, n + 1))]]) * sample_time) @ [*x, 1.0])[:n]
    np.testing.assert_allclose(run["n.x"], rows, rtol=1e-11, atol=1e-11 * np.abs(rows).max())


@EULER
def test_a_linear_block_goes_by_the_recurrence_of_the_named_method(method):
    block = network(4).replace(name="n")
    run = run_of(block, Wave()(), method)
    x, rows = block.start.copy(), []
    for k in range(TICKS + 1):
        rows.append(x)
        new, u = x.copy(), wave(k * T)
        for i in (2, 1, 0):
            new[i] = x[i] + T * (block.A[i] @ (new if method == "semi_implicit" else x) + block.B[i] @ u + block.g[i])
        x = new
    np.testing.assert_allclose(run["n.x"], rows, rtol=1e-11, atol=1e-11)


def test_blocks_of_one_structure_keep_their_own_numbers():
    # equal structure shares one trace; the matrices of the hold are each block's own
    a, b = network(5).replace(name="a"), network(6).replace(name="b")

    @subsystem(sample_time=0.1)
    def box(u):
        return {"first": a(u).x, "second": b(u).x}

    run = Diagram("two", *box(Wave()())).simulate(0.1, progress=False)
    for block in (a, b):
        drive = block.B @ wave(0.0) + block.g
        want = expm(0.1 * block.A) @ block.start + np.linalg.solve(block.A, (expm(0.1 * block.A) - np.eye(3)) @ drive)
        np.testing.assert_allclose(run[f"{block.name}.x"][1], want, rtol=1e-12, atol=1e-12)


def test_the_sample_time_is_that_of_the_frame():
    # two rates: ticks every 10 ms, the network every 50 ms, held between
    block = network(7).replace(name="n")

    @subsystem(sample_time=0.05)
    def slow(u):
        return block(u)

    @subsystem(sample_time=0.02)
    def fast(u):
        return network(8).replace(name="other")(u)

    signal = Wave()()
    run = Diagram("rates", slow(signal), fast(signal)).simulate(1.0, step=0.01, progress=False)
    assert np.diff(run.t) == pytest.approx(0.01)
    n, x = len(block.g), block.start
    for k in range(20):
        rows = run["n.x"][5 * k : 5 * k + 5]
        np.testing.assert_allclose(rows, np.broadcast_to(x, rows.shape), rtol=1e-11, atol=1e-11)
        drive = (block.B @ wave(0.05 * k) + block.g)[:, None]
        x = (expm(np.block([[block.A, drive], [np.zeros((1, n + 1))]]) * 0.05) @ [*x, 1.0])[:n]


def test_the_hold_of_one_state_that_is_exported_is_two_functions_of_its_time_constant():
    """Ad = e^(aT) and Φ = T (e^(aT) − 1)/(aT), at a = 0, too; one state took the series and squarings of many."""
    a = ca.MX.sym("a")
    held = hold_of_symbols([[wrap(a, ())]], 0.5, "exact")
    function = ca.Function("hold", [a], [part.to_casadi() for part in held])
    for value in (0.0, -1e-300, 1e-9, -0.3, 2.0, -40.0, -4e3):
        decay, gain = map(float, function(value))
        z = mpmath.mpf(value) / 2
        assert decay == pytest.approx(float(mpmath.exp(z)), rel=1e-15)
        assert gain == pytest.approx(0.5 * float(mpmath.expm1(z) / z if value else 1), rel=1e-15)
    assert function.n_instructions() < 20
