"""Algebraic loops in compiled runs: solved in C, with the bits and the words of interpreted runs."""

import numpy as np
import pytest
from scipy.optimize import brentq

from loopwright.blocks import Function, Gain, SimulationError, Sine, UnitDelay
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.compiled import write_code
from loopwright.diagrams.flat import kinds_of
from support.both_forms import assert_same_bits, both

QUIET = {"progress": False}


def loop_of(equation, every=0.01, **options):
    """y = equation(y, u) at every tick, u a sine."""

    @subsystem(sample_time=every, name="box")
    def box(u):
        around = Function(equation, name="f")
        return around(Gain(gain=1.0, name="g")(around.y), u)

    return Diagram("d", box(Sine(frequency=2.0, name="source")).named("y"), loops="solve", **options)


def test_a_linear_loop_has_the_solution_of_its_equation():
    interpreted, compiled = both(loop_of(lambda v, u: u - 3.0 * v), 1.0)
    assert_same_bits(interpreted, compiled)
    assert np.max(np.abs(compiled["y"] - compiled["source.y"] / 4.0)) < 1e-15


def test_a_nonlinear_loop_has_the_solution_that_scipy_finds():
    """y + e^y = 1 + u."""
    interpreted, compiled = both(loop_of(lambda v, u: 1.0 + u - np.exp(v)), 1.0)
    assert_same_bits(interpreted, compiled)
    expected = [brentq(lambda v, u=u: v + np.exp(v) - 1.0 - u, -9.0, 9.0, xtol=1e-15) for u in compiled["source.y"]]
    assert np.max(np.abs(compiled["y"] - expected)) < 1e-13
    assert np.max(compiled.residual) < 1e-14


def matrix_loop(n, seed=3):
    """v = A v + b u + 0.1 sin(v), with the linear part as a dense matrix."""
    A = np.random.default_rng(seed).normal(size=(n, n)) * 0.3 / np.sqrt(n)
    b = np.linspace(1.0, 2.0, n)

    @subsystem(sample_time=0.02, name="box")
    def box(u):
        around = Function(lambda v, u: v + 0.1 * np.sin(v) + b * u, name="f", arguments={"v": (n,), "u": ()})
        return around(Gain(gain=A, name="A")(around.y), u)

    return Diagram("d", box(Sine(frequency=1.0, name="source")), loops="solve"), A, b


@pytest.mark.parametrize("n", [4, 7, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 3))])
def test_loops_of_several_values_satisfy_their_equations(n):
    made, A, b = matrix_loop(n)
    interpreted, compiled = both(made, 1.0)
    v, u = compiled["box.f.y"], compiled["source.y"]
    left = v @ A.T
    assert np.max(np.abs(left + 0.1 * np.sin(left) + np.outer(u, b) - v)) < 1e-12
    assert_same_bits(interpreted, compiled)
    assert not compiled.messages
    flat = made.flatten()
    assert write_code(flat, kinds_of(flat, every=False)).exact  # so that compile="auto" changes over, too


def test_a_loop_at_one_of_several_rates_is_solved_where_it_acts():
    @subsystem(sample_time=0.03, name="slow")
    def slow(u):
        around = Function(lambda v, u: u - 3.0 * v, name="f")
        return around(Gain(gain=1.0, name="g")(around.y), u)

    @subsystem(sample_time=0.02, name="fast")
    def fast(u):
        return Gain(gain=2.0, name="g")(u)

    source = Sine(frequency=2.0, name="source")
    interpreted, compiled = both(Diagram("d", slow(source).named("a"), fast(source).named("b"), loops="solve"), 1.0)
    assert_same_bits(interpreted, compiled)
    acts = np.round(compiled.t / 0.01) % 3 == 0
    assert np.max(np.abs(compiled["a"] - compiled["source.y"] / 4.0)[acts][:-1]) < 1e-15


def failing(made):
    found = []
    for form in (False, True):
        with pytest.raises(SimulationError) as caught:
            made.simulate(3.0, compile=form, **QUIET)
        found.append((str(caught.value), caught.value.run.data.tobytes(), caught.value.t))
    assert found[0] == found[1]
    return found[0]


def test_a_loop_that_loses_its_solution_says_the_same_and_keeps_the_same():
    """e^y = 0.9 + u has no solution where 0.9 + u falls below 0."""
    text, _, t = failing(loop_of(lambda v, u: v + np.exp(v) - 0.9 - u))
    assert "f.y" in text
    expected = (np.pi + np.arcsin(0.9)) / (4.0 * np.pi)
    assert abs(t - expected) <= 0.0101


def test_a_loop_that_becomes_undetermined_says_the_same():
    """y = y + u (y − 1): at u = 0 every y solves it."""

    def equation(v, u):
        return v + np.where(u > 0.9, 0.0, 1.0) * (v - 1.0)

    text, _, t = failing(loop_of(equation))
    assert "f.y: it is singular" in text
    assert t == pytest.approx(np.ceil(np.arcsin(0.9) / (4.0 * np.pi) / 0.01) * 0.01)  # the first tick with u above 0.9


def test_a_loop_through_states_goes_on_from_saved_states():
    @subsystem(sample_time=0.01, name="box")
    def box(u):
        around = Function(lambda v, u, x: u - np.tanh(v) + 0.5 * x, name="f")
        memory = UnitDelay(initial_value=0.2, name="x")
        return memory(around(Gain(gain=1.0, name="g")(around.y), u, memory.y))

    made = Diagram("d", box(Sine(frequency=2.0, name="source")), loops="solve")
    whole = made.simulate(0.4, **QUIET)
    half = made.simulate(0.2, compile=True, **QUIET).final_state
    assert made.simulate(0.2, start=half, compile=True, **QUIET).data.tobytes() == whole.data[20:].tobytes()
    assert made.simulate(0.2, start=half, **QUIET).data.tobytes() == whole.data[20:].tobytes()
