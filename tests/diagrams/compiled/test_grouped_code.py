"""Grouped code: one C function for each kind of block, with the bits of the blocks evaluated one by one.

Interpreted runs go by the same tables of blocks, so that loops by hand stand beside the equality of bits.
"""

import os
import signal
from time import sleep

import numpy as np
import pytest

from loopwright.blocks import (
    PID,
    Compare,
    DiscreteIntegrator,
    Gain,
    Lookup1D,
    Product,
    PulseTrain,
    PythonFunction,
    Sine,
    Sum,
    TransferFunction,
    UnitDelay,
)
from loopwright.diagrams import Diagram, Interrupted, subsystem
from loopwright.diagrams.compiled import compiled_libraries, grouped_functions
from loopwright.diagrams.flat import flat_diagram
from support.both_forms import assert_same_bits, both
from support.hybrid_blocks import counting
from support.random_cases import random_cases
from support.random_linear import BASE, PERIOD, Matrices, diagram, specs

QUIET = {"progress": False}


@pytest.fixture
def grouped(monkeypatch):
    """Every diagram is compiled block by block."""
    monkeypatch.setattr(flat_diagram, "LARGEST", 0)


def boxed(inside, every=0.01, source=None):
    return Diagram("d", subsystem(sample_time=every, name="box")(inside)(source or Sine(frequency=3.0, name="source")))


def chain(n):
    """Gains and delays in turn."""

    def inside(signal):
        for i in range(n):
            kind = UnitDelay(initial_value=0.0, name=f"b{i}") if i % 2 else Gain(gain=1.0 - 1e-3 * i, name=f"b{i}")
            signal = kind(signal)
        return signal

    return boxed(inside)


def loops(n):
    """PID controllers of lags, each driven by the one before."""

    def inside(signal):
        for i in range(n):
            lag = TransferFunction(numerator=1.0, denominator=[0.05 + 1e-3 * i, 1.0], name=f"lag{i}")
            signal = lag(PID(kp=2.0, ki=1.0, kd=0.01, filter_time=0.01, name=f"pid{i}")(signal, lag.y))
        return signal

    return boxed(inside)


def test_a_chain_of_800_blocks_has_the_bits_of_numpy():
    _, run = both(chain(800), 0.5, record=["source", "box.b1", "box.b40", "box.b399"])
    u = run["source.y"]
    for last in (1, 40, 399):
        expected = u.copy()
        for i in range(last + 1):
            expected = np.concatenate([[0.0], expected[:-1]]) if i % 2 else (1.0 - 1e-3 * i) * expected
        assert np.array_equal(run[f"box.b{last}.y"], expected)


def test_many_controllers_are_those_of_a_loop_by_hand():
    """Lags are exact for an input that is held, and so is the filter of the derivative."""
    made, n, T, tau = loops(70), 70, 0.01, 0.01
    assert made.wired.flattened(None).by_block
    runs = both(made, 1.0)
    times = 0.05 + 1e-3 * np.arange(n)
    decay, forget = np.exp(-T / times), np.exp(-T / tau)
    y, integral, filtered, expected = np.zeros(n), np.zeros(n), np.zeros(n), []
    for k in range(101):
        expected.append(y)
        r = np.concatenate([[np.sin(0.06 * np.pi * k)], y[:-1]])
        u = 2.0 * (r - y) + integral - 0.01 * (y - filtered) / tau
        integral, filtered = integral + T * (r - y), forget * filtered + (1.0 - forget) * y
        y = decay * y + (1.0 - decay) * u
    expected = np.array(expected)
    for run in runs:
        for i in (0, 1, 35, 69):
            size = np.max(np.abs(expected[:, i]))  # each lag damps: 1e-27 behind seventy
            np.testing.assert_allclose(run[f"box.lag{i}.y"], expected[:, i], rtol=0.0, atol=1e-10 * size)


@pytest.mark.parametrize(("make", "n"), [(chain, 600), (loops, 70), pytest.param(loops, 600, marks=pytest.mark.slow)])
def test_large_diagrams_have_the_bits_of_their_interpreted_runs(make, n):
    made = make(n)
    assert made.wired.flattened(None).by_block
    assert_same_bits(*both(made, 1.0))


def test_a_large_diagram_is_never_traced_as_a_whole(monkeypatch):
    def refused(*_, **__):
        raise AssertionError("traced as a whole")

    expected = loops(70).simulate(0.2, compile=False, **QUIET)
    monkeypatch.setattr(flat_diagram.flat_functions, "trace_tick", refused)
    assert_same_bits(expected, loops(70).simulate(0.2, compile=True, **QUIET))


def test_the_code_knows_neither_the_number_of_blocks_nor_their_parameters(monkeypatch, tmp_path):
    monkeypatch.setenv("LOOPWRIGHT_CACHE", str(tmp_path))
    compiled_libraries.load_compiled.cache_clear()
    loops(70).simulate(0.1, compile=True, **QUIET)
    built = sorted((tmp_path / "compiled").iterdir())
    compiled_libraries.load_compiled.cache_clear()
    loops(80).replace({"box.pid7.kp": 3.5}).simulate(0.1, compile=True, **QUIET)
    assert sorted((tmp_path / "compiled").iterdir()) == built


def test_terms_that_cancel_across_blocks_are_rounded_block_by_block(grouped):
    """(a − u) + u is not a: both forms say so."""

    def inside(u):
        left = Sum(signs="+-", name="left")(1e-3, u)
        return Sum(signs="++", name="back")(left, u)

    interpreted, compiled = both(boxed(inside), 1.0)
    assert_same_bits(interpreted, compiled)
    u = compiled["source.y"]
    assert np.array_equal(compiled["box.back.y"], (1e-3 - u) + u)
    assert not np.all(compiled["box.back.y"] == 1e-3)


@random_cases(2, 30, specs(least=12, continuous=False))
def test_random_linear_diagrams_have_the_same_bits_and_the_product_of_matrices(spec):
    small = spec.scaled(0.1)
    ticks, expected = Matrices(small).run(PERIOD)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flat_diagram, "LARGEST", 0)
        interpreted, compiled = both(diagram(small), PERIOD * BASE, step=BASE)
    assert_same_bits(interpreted, compiled)
    rows = np.searchsorted(compiled.t, np.array(ticks) / 100)
    found = np.hstack([np.reshape(compiled[f"b{i}.y"], (len(compiled.t), -1)) for i in range(len(small.nodes))])
    assert np.max(np.abs(found[rows] - expected)) < 1e-10 * max(1.0, np.max(np.abs(expected)))


@pytest.mark.parametrize("mode", ["reset", pytest.param("held", marks=pytest.mark.slow)])
def test_enabled_boxes_count_while_they_are_enabled(grouped, mode):
    enable = PulseTrain(period=1.0, duty=0.5)
    interpreted, compiled = both(Diagram("d", counting(0.1, enabled=mode, start=0.0)(enable=enable).named("n")), 2.0)
    assert_same_bits(interpreted, compiled)
    after = {"held": 6, "reset": 1}[mode]
    assert compiled["n"][[4, 8, 10]].tolist() == [5, 5, after]


@pytest.mark.parametrize("edge", ["both", *(pytest.param(e, marks=pytest.mark.slow) for e in ("rising", "falling"))])
def test_triggered_boxes_count_edges_with_the_same_bits(grouped, edge):
    @subsystem(sample_time=0.02, name="outer")
    def outer(u):
        return counting(name="inner", triggered=edge)(trigger=Compare(">")(u, 0.3))

    interpreted, compiled = both(Diagram("d", outer(Sine(frequency=2.0)).named("n")), 3.0)
    assert_same_bits(interpreted, compiled)
    above = np.sin(0.08 * np.pi * np.arange(151)) > 0.3
    change = np.diff(np.concatenate([[False], above]).astype(int))
    edges = {"both": change != 0, "rising": change > 0, "falling": change < 0}[edge]
    assert compiled["n"].tolist() == np.maximum(np.cumsum(edges), 1).tolist()  # 1 before the first one, too


def test_nested_gates_of_several_rates_with_delays_have_the_same_bits(grouped):
    @subsystem(sample_time=0.02, enabled="reset", name="outer")
    def outer(u):
        slow = subsystem(sample_time=0.06, name="slow")(lambda v: DiscreteIntegrator(name="sum")(v))(u)
        late = subsystem(sample_time=0.02, delay=2, name="late")(lambda v: Gain(gain=-2.0, name="g")(v))(u)
        return counting(name="inner", enabled="held", start=2.0)(enable=Compare(">")(u, 0.0)) + slow + late

    made = Diagram("d", outer(Sine(frequency=1.0), enable=PulseTrain(period=0.5, duty=0.6)).named("y"))
    assert_same_bits(*both(made, 3.0))


def test_parts_of_vectors_and_matrices_have_the_same_bits(grouped):
    def inside(u):
        both = Gain(gain=[[1.0, 2.0], [3.0, -1.0], [0.5, 0.0]], name="m")
        back = Gain(gain=[[1.0, 2.0, 0.1], [0.0, 1.0, 3.0]], name="n")
        drive = Gain(gain=[1.0, -2.0], name="drive")
        delay = UnitDelay(initial_value=[0.0, 0.0], name="x")
        y = both(delay.y)
        delay(0.1 * back(y) + drive(u))
        return Product(name="p")(y[0], y[2]) + y[1]

    interpreted, compiled = both(boxed(inside), 1.0)
    assert_same_bits(interpreted, compiled)
    m, n = np.array([[1.0, 2.0], [3.0, -1.0], [0.5, 0.0]]), np.array([[1.0, 2.0, 0.1], [0.0, 1.0, 3.0]])
    x = np.zeros(2)
    for u, product in zip(compiled["source.y"], compiled["box.p.y"], strict=True):
        y = m @ x
        assert product == pytest.approx(y[0] * y[2], abs=1e-12)
        x = 0.1 * n @ y + np.array([1.0, -2.0]) * u


def test_tables_beside_other_blocks_have_the_same_values(grouped):
    def inside(u):
        table = Lookup1D(breakpoints=[-1.0, 0.0, 0.5, 1.0], values=[2.0, -1.0, 0.25, 3.0], name="table")(u)
        return Gain(gain=2.0, name="g")(table) + u

    interpreted, compiled = both(boxed(inside), 2.0)
    assert np.array_equal(interpreted.data, compiled.data)
    expected = 2.0 * np.interp(compiled["source.y"], [-1.0, 0.0, 0.5, 1.0], [2.0, -1.0, 0.25, 3.0])
    assert np.max(np.abs(compiled["box.g.y"] - expected)) < 1e-14


# --- blocks of Python -------------------------------------------------------------------------------------------------


def with_python(function):
    def inside(u):
        memory = UnitDelay(initial_value=0.5, name="memory")
        called = PythonFunction(function, name="python")(memory.y, u)
        return memory(0.5 * called)

    return boxed(inside)


def test_blocks_of_python_are_called_from_c_and_have_the_numbers_of_a_loop_in_python():
    def step(x, u):
        return float(np.tanh(x) + u)

    interpreted, compiled = both(with_python(step), 1.0)
    assert_same_bits(interpreted, compiled)
    x, expected = 0.5, []
    for u in compiled["source.y"]:
        expected.append(x)
        x = 0.5 * step(x, u)
    assert compiled["box.memory.y"].tolist() == expected


def test_an_exception_in_a_block_of_python_says_the_same_in_both_forms():
    def fails(x, u):
        if u < -0.5:
            raise ValueError("too low")
        return x + u

    texts = []
    for form in (False, True):
        with pytest.raises(Exception, match="too low") as caught:
            with_python(fails).simulate(1.0, compile=form, **QUIET)
        texts.append((type(caught.value), str(caught.value), caught.value.run.data.tobytes()))
    assert texts[0] == texts[1]


def test_slow_ticks_come_back_to_python_often():
    """A tick of 1 ms: Ctrl-C and the progress bar have their turn after 0.1 s of them, which are at most 100."""

    def slow(x, u):
        sleep(1e-3)
        return u

    told = [0.0]
    with with_python(slow).simulation(compile=True) as simulation:
        simulation.advance(4.0, progress=told.append)
    assert np.max(np.diff(told)) < 1.3  # s of simulated time: 128 ticks


def test_an_interrupt_in_a_block_of_python_ends_the_run():
    calls = []

    def interrupted(x, u):
        calls.append(1)
        if len(calls) == 60:
            raise KeyboardInterrupt
        return x + u

    with with_python(interrupted).simulation(compile=True) as simulation, pytest.raises(KeyboardInterrupt) as caught:
        simulation.advance(1.0)
    assert 0.4 < caught.value.run.t[-1] < 0.6


@pytest.mark.skipif(os.name != "posix", reason="sends itself a signal")
def test_an_interrupt_that_comes_as_c_calls_python_ends_the_run(monkeypatch):
    """Python would raise it at the first instruction of the function that C calls, where ctypes drops it."""
    calls, entries = [], [0]

    def enter(call, before=grouped_functions.call_for_c):
        entries[0] += 1
        if entries[0] == 60:
            signal.raise_signal(signal.SIGINT)
        before(call)

    monkeypatch.setattr(grouped_functions, "call_for_c", enter)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(Interrupted), with_python(lambda x, u: calls.append(1) or u).simulation(compile=True) as s:
            s.advance(100.0)
    finally:
        signal.signal(signal.SIGINT, before)
    assert 59 <= len(calls) < 10_000
