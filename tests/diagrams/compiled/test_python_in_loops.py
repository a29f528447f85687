"""Blocks of Python beside algebraic loops, in them, and beside FMUs in model exchange, in C's loop."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from loopwright.blocks import (
    Block,
    Gain,
    Input,
    Output,
    PythonFunction,
    SimulationError,
    Sine,
    Sum,
    TransferFunction,
    UnitDelay,
)
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.flat import flat_diagram
from loopwright.diagrams.simulation.algebraic_loops import LoopSolver
from loopwright.fmus import Fmu, mass_spring_damper
from support.controlled_mass import START, A, B

pytestmark = pytest.mark.one_tier
QUIET = {"progress": False}


class Root(Block):
    """y = √u."""

    u = Input()
    y = Output()

    def output(self, t, x, u):
        return np.sqrt(u.u)


def python(function, name="python"):
    return PythonFunction(function, arguments={"u": ()}, results={"y": ()}, name=name)


def sampled(function):
    """y = u − tanh-like function of y, and a delay behind it."""

    @subsystem(sample_time=0.01, name="box")
    def box(u):
        total, called = Sum(signs="+-", name="total"), python(function)
        y = total(u, called(total.y))
        return UnitDelay(initial_value=0.0, name="late")(y)

    return Diagram("d", box(Sine(frequency=3.0, name="source")), loops="solve")


def test_a_function_of_python_in_a_sampled_loop_is_solved(all_in_c):
    run = sampled(lambda u: float(0.5 * np.tanh(u))).simulate(0.5, **QUIET)
    for u, y in zip(run["source.y"], run["box.total.y"], strict=True):
        assert y == pytest.approx(brentq(lambda y, u=u: y - u + 0.5 * np.tanh(y), -3, 3, xtol=1e-14), abs=1e-9)
    own = sampled(lambda u: float(0.5 * np.tanh(u))).simulate(0.5, compile=False, **QUIET)
    assert own.data.tobytes() == run.data.tobytes()


@pytest.mark.parametrize("solver", ["rk4", "RK45", "Radau"])
@pytest.mark.drawn(2)
def test_a_function_of_python_beside_a_loop_between_ticks_is_evaluated(all_in_c, solver):
    """y = u − 0.5 y, so y = 2 u / 3; the lag x' = 2 u / 3 − x of a sine by Python."""
    total, half = Sum(signs="+-", name="total"), Gain(gain=0.5, name="half")
    clock = TransferFunction(numerator=1.0, denominator=[1.0, 0.0], name="clock")
    sine = python(lambda u: float(np.sin(u)))(clock(Sine(frequency=0.0, bias=1.0, name="one")))
    y = total(sine, half(total.y))
    made = Diagram("d", TransferFunction(numerator=1.0, denominator=[1.0, 1.0], name="lag")(y), loops="solve")
    run = made.simulate(2.0, step=0.01, solver=solver, rtol=1e-8, atol=1e-10, **QUIET)
    t = run.t
    expected = 2.0 / 3.0 * (np.sin(t) - np.cos(t) + np.exp(-t)) / 2.0
    assert np.max(np.abs(run["lag.y"] - expected)) < 1e-6


@pytest.mark.parametrize("form", ["auto", False])
@pytest.mark.parametrize("large", [False, True])
def test_an_error_within_a_loop_names_the_block(form, large, monkeypatch):
    """The value of a block whose output closes a loop is recorded as it was taken, so that NaN is seen nowhere else."""
    if large:
        monkeypatch.setattr(flat_diagram, "LARGEST", 0)

    def fails(u):
        if u < -0.3:
            raise ValueError("too low")
        return 0.5 * u

    with pytest.raises(
        SimulationError, match=r"box\.python, t = 0\.\d+ s: its output failed: ValueError: too low"
    ) as caught:
        sampled(fails).simulate(2.0, compile=form, **QUIET)
    assert (
        0.15 < caught.value.run.t[-1] < 0.21
    )  # 2 sin(6π t) / 3 is below −0.3 from 0.191 s on; slopes are looked at beside it


class Steep(Block):
    """y = 3 sin u."""

    u = Input()
    y = Output()

    def output(self, t, x, u):
        return 3.0 * np.sin(u.u)


@pytest.mark.parametrize("continuous", [False, True])
def test_an_interrupt_where_python_solves_a_loop_keeps_what_was_recorded(monkeypatch, continuous):
    """y = u − 3 sin y has folds, beyond which Newton's method in C fails and Python's is asked: there Ctrl-C comes."""
    solve, came = LoopSolver.solve, []

    def interrupted(self, **more):
        if self.t[0] > 0.05 and not came:
            came.append(float(self.t[0]))
            raise KeyboardInterrupt
        solve(self, **more)

    monkeypatch.setattr(LoopSolver, "solve", interrupted)

    @subsystem(sample_time=0.01, name="box")
    def box(u):
        total = Sum(signs="+-", name="total")
        return UnitDelay(initial_value=0.0, name="late")(total(u, Steep(name="steep")(total.y)))

    out = box(Sine(frequency=1.0, amplitude=8.0, name="source"))
    lag = TransferFunction(numerator=1.0, denominator=[1.0, 1.0], name="lag")
    made = Diagram("d", lag(out) if continuous else out, loops="solve")
    with pytest.raises(KeyboardInterrupt, match="interrupted at t = ") as caught:
        made.simulate(20.0, step=0.01, **QUIET)
    assert came[0] - 0.0101 < caught.value.run.t[-1] <= came[0] + 1e-9


@pytest.mark.parametrize("form", ["auto", True])
def test_a_root_that_fails_within_a_loop_is_told(form):
    """y = √(u − y / 2) − 0.2 for a sine u, which becomes negative."""

    @subsystem(sample_time=0.01, name="box")
    def box(u):
        total, root = Sum(signs="+-", name="total"), Root(name="root")
        return total(root(Sum(signs="+-", name="inner")(u, Gain(gain=0.5, name="half")(total.y))), 0.2)

    made = Diagram("d", box(Sine(frequency=3.0, bias=0.5, name="source")), loops="solve")
    with pytest.raises(SimulationError, match="root|half|total|inner"):
        made.simulate(2.0, compile=form, **QUIET)


@pytest.mark.parametrize("solver", ["RK45", "Radau"])
@pytest.mark.parametrize("isolate", [False, True])
@pytest.mark.drawn(1)
def test_a_function_of_python_beside_an_fmu_in_model_exchange(all_in_c, solver, isolate):
    """A force by Python that damps the mass further, 3 N s/m: the exponential of the matrix."""
    plant = Fmu(mass_spring_damper.build(), interface="model_exchange", name="plant", isolate=isolate)
    made = Diagram("d", plant(force=python(lambda u: -3.0 * u)(plant.velocity)))
    options = {"step": 0.01, "solver": solver, "rtol": 1e-9, "atol": 1e-12, **QUIET}
    run = made.simulate(1.0, **options)
    matrix = A - 3.0 * B @ np.array([[0.0, 1.0]])
    expected = [(expm(matrix * t) @ [START, 0.0])[0] for t in run.t]
    assert np.max(np.abs(run["plant.position"] - expected)) < 1e-7
