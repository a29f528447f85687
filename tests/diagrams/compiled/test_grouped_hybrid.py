"""Grouped code of diagrams with continuous states: rates, events and derivatives by tables of equal blocks."""

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import (
    Constant,
    Gain,
    Integrator,
    PythonFunction,
    Sine,
    StateSpace,
    Step,
    Sum,
    TransferFunction,
    UnitDelay,
)
from loopwright.blocks.core import SimulationError
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.compiled import functions_between, write_code
from loopwright.diagrams.compiled.rate_differences import find_columns
from loopwright.diagrams.flat import NONE, flat_diagram

QUIET = {"progress": False}


@pytest.fixture
def grouped(monkeypatch):
    """Every diagram is compiled block by block."""
    monkeypatch.setattr(flat_diagram, "LARGEST", 0)


def lag_of(rate, start, name):
    return StateSpace(A=[[-rate]], B=[rate], C=[1.0], D=0.0, initial_state=start, name=name)


def ring(n, rate=1.0):
    """Lags x' = rate (u − x), each driven by 0.3 times the sum of two others."""
    lags = [lag_of(rate, float(i == 0), f"x{i}") for i in range(n)]
    calls = []
    for i, lag in enumerate(lags):
        total = Sum(signs="+-", name=f"s{i}")(lags[(i + 1) % n].y, lags[(7 * i + 3) % n].y)
        calls.append(lag(Gain(gain=0.3, name=f"g{i}")(total)))
    return Diagram("ring", *calls), [f"x{i}" for i in range(n)]


def matrix_of(n, rate=1.0):
    a = -np.eye(n)
    for i in range(n):
        a[i, (i + 1) % n] += 0.3
        a[i, (7 * i + 3) % n] -= 0.3
    return rate * a


@pytest.mark.parametrize("solver", ["DOP853", "Radau"])
def test_a_ring_of_lags_is_the_matrix_exponential(grouped, solver):
    n, rate = 12, 5.0
    made, names = ring(n, rate)
    run = made.simulate(1.0, step=0.05, solver=solver, rtol=1e-9, atol=1e-11, compile=True, **QUIET)
    assert run.tier == "compiled"
    start = np.array([run[f"{name}.y"][0] for name in names])
    expected = expm(matrix_of(n, rate)) @ start
    assert np.max(np.abs([run[f"{name}.y"][-1] for name in names] - expected)) < 1e-8


def test_the_code_of_many_blocks_is_as_short_as_that_of_few(grouped):
    """A compiler reads no more of it: straight-line code of 300 blocks took it seconds."""
    texts = []
    for n in (20, 60):
        flat = ring(n)[0].flatten(1e-3)
        texts.append(write_code(flat, [NONE], functions_between(flat, stiff=True)).texts[0])
    assert abs(len(texts[1]) - len(texts[0])) < 0.02 * len(texts[0])


def test_the_derivative_of_the_rates_needs_few_evaluations(grouped):
    n = 40
    made, _ = ring(n)
    flat = made.flatten(1e-3)
    found = find_columns(flat.part_program("flow"), flat.continuous)
    assert len(found.first) - 1 <= 9  # colors; a column for itself would be 40
    dense = np.zeros((n, n), bool)
    dense[found.pattern] = True
    order = [flat.continuous.tolist().index(flat.states.slices[f"x{i}"].start) for i in range(n)]
    assert np.all(dense[np.ix_(order, order)] >= (matrix_of(n) != 0.0))
    assert np.sum(dense) <= 3 * n
    for color in range(len(found.first) - 1):
        columns = found.columns[found.first[color] : found.first[color + 1]]
        assert np.sum(dense[:, columns], axis=1).max() == 1


def test_states_of_a_vector_depend_on_what_their_entries_do(grouped):
    a = [[-1.0, 0.5, 0.0], [0.0, -2.0, 0.0], [0.0, 0.0, -3.0]]
    system = StateSpace(A=a, B=np.eye(3), C=np.eye(3), D=np.zeros((3, 3)), name="system")
    made = Diagram("vector", system(Gain(gain=np.eye(3)[::-1], name="back")(system.y)))
    flat = made.flatten(1e-3)
    found = find_columns(flat.part_program("flow"), flat.continuous)
    dense = np.zeros((3, 3), bool)
    dense[found.pattern] = True
    assert np.all(dense[np.array(a) + np.eye(3)[::-1] != 0.0])


def test_a_block_of_python_is_called_from_c():
    """u = sin through a lag, the sine by Python: the closed form."""
    sine = PythonFunction(np.sin, arguments={"u": ()}, results={"y": ()}, name="python")
    clock = TransferFunction(numerator=1.0, denominator=[1.0, 0.0], name="t")
    lag = TransferFunction(numerator=1.0, denominator=[0.5, 1.0], name="lag")
    made = Diagram("python", lag(sine(clock(Gain(gain=1.0)(Sine(frequency=0.0, bias=1.0, name="one"))))))
    run = made.simulate(1.0, step=0.1, rtol=1e-7, atol=1e-9, compile=True, **QUIET)
    assert run.tier == "compiled"
    t, w = run.t, 0.5
    expected = (np.sin(t) - w * np.cos(t) + w * np.exp(-t / w)) / (1.0 + w**2)
    assert np.max(np.abs(run["lag.y"] - expected)) < 1e-6


def test_an_error_of_a_block_of_python_is_told_as_in_interpreted_runs():
    def fail(u):
        if u > 0.9:
            raise ValueError("too large")
        return u

    source = Sine(frequency=1.0, name="source")
    python = PythonFunction(fail, arguments={"u": ()}, results={"y": ()}, name="python")
    made = Diagram("failing", TransferFunction(numerator=1.0, denominator=[0.1, 1.0], name="lag")(python(source)))
    found = []
    for form in (False, True):
        with pytest.raises(SimulationError, match=r"python, t = 0\.178\d* s: its output failed: ValueError") as error:
            made.simulate(0.5, step=1e-3, compile=form, **QUIET)
        found.append(error.value.run.t[-1])
    assert found[0] == found[1]


@pytest.mark.parametrize("form", ["interpreted", "compiled", "grouped"])
@pytest.mark.parametrize(("mode", "solver"), [("held", "RK45"), ("reset", "rk4")])
def test_the_output_that_an_open_subsystem_will_hold_is_recorded(form, mode, solver, monkeypatch):
    """Between ticks x lagged behind by a tick in C, and by a step of the solver in Python."""
    if form == "grouped":
        monkeypatch.setattr(flat_diagram, "LARGEST", 0)

    @subsystem(enabled=mode, name="box")
    def box(u):
        return Integrator(name="inner")(u)

    @subsystem(sample_time=0.1, name="sampled")
    def sampled(u):
        return UnitDelay(initial_value=0.0, name="delay")(u)

    enable = Step(times=(0.25, 0.75), values=(1.0, 0.0), name="enable")
    made = Diagram("held", sampled(box(Constant(value=1.0, name="one"), enable=enable)))
    run = made.simulate(1.0, step=0.05, solver=solver, compile=form != "interpreted", **QUIET)
    held = made.flatten(0.05).held.slices["box.inner.y"].start
    found = np.array([run.at(t).state[held] for t in run.t])
    assert found == pytest.approx(np.clip(run.t - 0.25, 0.0, 0.5), abs=1e-9)


def test_the_rates_of_a_grouped_run_are_not_traced_as_a_whole(grouped):
    """Tracing takes seconds with 10,000 blocks; C evaluates a function for each kind of block."""
    made, _ = ring(6)
    with made.simulation(step=0.05, solver="rk4", compile=True) as simulation:
        simulation.advance(1.0)
        assert "flow" not in vars(simulation.flat)
        assert simulation.run().tier == "compiled"


def test_all_blocks_are_gone_through_once_for_the_instants_between_ticks(grouped, monkeypatch):
    made = []
    evaluate = flat_diagram.flat_functions.evaluate
    monkeypatch.setattr(
        flat_diagram.flat_functions,
        "evaluate",
        lambda *given, **more: (made.append(given[2]), evaluate(*given, **more))[1],
    )
    flat = ring(12)[0].flatten(0.1)
    sources = write_code(flat, [NONE], functions_between(flat, stiff=False))
    assert made == [NONE]  # for rates, outputs, and where it is asked whether these may fail at steps
    del sources
    write_code(flat, [NONE], functions_between(flat, stiff=False))
    assert made == [NONE, NONE]  # it is large, and isn't kept


def test_all_blocks_are_gone_through_once_for_an_interpreted_run(grouped, monkeypatch):
    """Instants between ticks and rates are traced together; a run is the matrix exponential, to the error of rk4."""
    made = []
    evaluate = flat_diagram.flat_functions.evaluate
    monkeypatch.setattr(
        flat_diagram.flat_functions,
        "evaluate",
        lambda *given, **more: (made.append(given[2]), evaluate(*given, **more))[1],
    )
    diagram, names = ring(12)
    run = diagram.simulate(1.0, step=0.01, solver="rk4", compile=False, **QUIET)
    assert made == [NONE]
    exact = expm(matrix_of(12)) @ [run[f"{name}.y"][0] for name in names]
    assert [run[f"{name}.y"][-1] for name in names] == pytest.approx(exact, abs=1e-8)
