"""Interpreted runs in C's loop, whose functions the virtual machine evaluates, and generated code that takes its place."""

import os
import signal

import numpy as np
import pytest
from scipy.linalg import expm

from loopwright.blocks import PID, Integrator, Lookup1D, Relay, Sine, StateSpace, TransferFunction, UnitDelay
from loopwright.blocks.core import CompilerError
from loopwright.diagrams import Diagram, subsystem
from loopwright.diagrams.compiled import background, bound_functions
from loopwright.diagrams.simulation import change_over

pytestmark = pytest.mark.one_tier
QUIET = {"progress": False}


@pytest.fixture(params=[0, 3])
def swapped(request, monkeypatch):
    """Generated code is there at some look at a run, without a thread; returns the number of looks so far."""
    looks = []

    class Later:
        def __init__(self, target, args, **_):
            self.start = lambda: target(*args)

    look = background.BackgroundCode.look

    def counted(self, spent, rest):
        looks.append(spent)
        if len(looks) > request.param:
            look(self, spent, 1e9)

    monkeypatch.setattr(background, "Thread", Later)
    monkeypatch.setattr(background.BackgroundCode, "look", counted)
    monkeypatch.setattr(change_over, "_PATIENCE", -1.0)
    return looks


def oscillator():
    """An oscillator of 3 rad/s with a damping of 0.1, from 1."""
    A = [[0.0, 1.0], [-9.0, -0.6]]
    return Diagram(
        "d",
        StateSpace(A=A, B=[0.0, 1.0], C=np.eye(2), D=[0.0, 0.0], initial_state=[1.0, 0.0], name="x")(
            Sine(frequency=0.0, name="u")
        ),
    )


def exact(t):
    """Its states."""
    return np.array([expm(np.array([[0.0, 1.0], [-9.0, -0.6]]) * time)[:, 0] for time in t])


def two_rates(table=False):
    """Two sampled subsystems, one of them with a table."""

    @subsystem(sample_time=0.01, name="fast")
    def fast(u):
        memory = UnitDelay(initial_value=0.0, name="sum")
        return memory(memory.y + 0.01 * u)

    @subsystem(sample_time=0.03, name="slow")
    def slow(u):
        return Lookup1D(breakpoints=[-1.0, 0.0, 2.0], values=[3.0, 0.0, -1.0], name="table")(u) if table else 2.0 * u

    return Diagram("d", fast(slow(Sine(frequency=0.7, name="u"))))


@pytest.mark.parametrize(
    ("solver", "options", "bound"),
    [
        ("rk4", {}, 2e-9),  # h = 1e-3: h⁴ · 3⁵ · 3 s / 120
        ("heun", {}, 2e-5),
        ("RK45", {"rtol": 1e-9, "atol": 1e-12}, 1e-7),
        ("DOP853", {"rtol": 1e-10, "atol": 1e-13}, 1e-8),
        ("Radau", {"rtol": 1e-8, "atol": 1e-11}, 1e-6),
        ("auto", {"rtol": 1e-9, "atol": 1e-12}, 1e-7),
    ],
)
@pytest.mark.drawn(3)
def test_a_solution_is_that_of_the_matrix_exponential_without_generated_code(solver, options, bound):
    run = oscillator().simulate(3.0, step=1e-3, solver=solver, compile=False, **options, **QUIET)
    assert run.tier == "interpreted"
    assert run.messages == ()
    np.testing.assert_allclose(run["x.y"], exact(run.t), rtol=0.0, atol=bound)


@pytest.mark.parametrize("table", [False, True])
def test_sampled_runs_are_those_of_a_loop_by_hand_and_have_the_bits_of_generated_code(table):
    made = two_rates(table)
    run = made.simulate(20.0, compile=False, **QUIET)
    source, expected, held, total = np.sin(2 * np.pi * 0.7 * np.arange(2001) / 100), [], 0.0, 0.0
    for k, u in enumerate(source):
        if k % 3 == 0:
            held = np.interp(u, [-1.0, 0.0, 2.0], [3.0, 0.0, -1.0]) if table else 2.0 * u
        expected.append(total)
        total += 0.01 * held
    np.testing.assert_allclose(run["fast.sum.y"], expected, rtol=0.0, atol=1e-12)
    assert made.simulate(20.0, compile=True, **QUIET).data.tobytes() == run.data.tobytes()


def test_a_loop_of_every_day_is_simulated_between_ticks_and_at_them():
    """A motor's speed under a PI controller, and its angle, by the matrix exponential from tick to tick."""
    plant = TransferFunction(numerator=2.0, denominator=[0.3, 1.0], name="plant")
    control = subsystem(sample_time=0.01, name="control")(lambda y: PID(kp=3.0, ki=2.0, name="pid")(1.0, y))
    made = Diagram("d", Integrator(name="angle")(plant(control(plant.y))))
    run = made.simulate(2.0, rtol=1e-9, atol=1e-12, compile=False, **QUIET)
    whole = expm(0.01 * np.array([[-1 / 0.3, 0.0, 2 / 0.3], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    x, integral, expected = np.zeros(2), 0.0, []
    for _ in range(201):
        expected.append(x)
        error = 1.0 - x[0]
        x = whole[:2, :2] @ x + whole[:2, 2] * (3.0 * error + integral)
        integral += 0.01 * 2.0 * error
    found = np.stack([run["plant.y"], run["angle.y"]], axis=1)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-7)


@pytest.mark.parametrize("solver", ["rk4", "RK45", "DOP853", "Radau"])
def test_generated_code_has_the_same_bits(solver):
    runs = [oscillator().simulate(3.0, step=1e-3, solver=solver, compile=c, **QUIET) for c in (False, True)]
    assert [run.tier for run in runs] == ["interpreted", "compiled"]
    assert runs[0].data.tobytes() == runs[1].data.tobytes()


@pytest.mark.parametrize("solver", ["rk4", "RK45", "Radau"])
@pytest.mark.drawn(2)
def test_it_makes_no_difference_when_generated_code_takes_its_place(swapped, solver):
    options = {"step": 1e-4, "solver": solver, **QUIET}
    runs = []
    for form in (False, "auto"):
        with oscillator().simulation(step=1e-4, solver=solver, compile=form) as simulation:
            simulation.advance(1.0)
            early = simulation.save()
            simulation.advance(2.0)
            runs.append(simulation.run())
    whole, run = runs
    assert run.tier == "both"
    assert len(swapped) > 0
    assert run.data.tobytes() == whole.data.tobytes()
    again = oscillator().simulate(2.0, start=early, compile=False, **options)
    np.testing.assert_allclose(again["x.y"], whole["x.y"][-len(again.t) :], rtol=0.0, atol=1e-9)


def test_sampled_runs_and_events_make_no_difference_either(swapped):
    relay = Relay(on_point=0.5, off_point=-0.5, name="relay")
    lag = TransferFunction(numerator=1.0, denominator=[0.2, 1.0], name="lag")
    for made, options in (
        (two_rates(), {}),
        (Diagram("d", lag(-2.0 * relay(lag.y) + 1.0)), {"step": 1e-3}),
    ):
        whole = made.simulate(60.0, compile=False, **options, **QUIET)
        run = made.simulate(60.0, **options, **QUIET)
        assert run.data.tobytes() == whole.data.tobytes()
        assert [e.t for e in run.events] == [e.t for e in whole.events]


def test_without_a_library_and_a_compiler_the_error_says_what_to_install(monkeypatch, tmp_path):
    from loopwright.diagrams.compiled import compiled_libraries

    monkeypatch.setattr(compiled_libraries, "installed_runtime", lambda: tmp_path / "none.so")
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for kept in (compiled_libraries.load_runtime, compiled_libraries.load_compiled):
        kept.cache_clear()
    try:
        with pytest.raises(CompilerError, match=r"pip install.*loopwright\[build\]"):
            oscillator().simulate(3.0, step=1e-3, compile=False, **QUIET)
    finally:
        compiled_libraries.load_runtime.cache_clear()


@pytest.mark.skipif(os.name != "posix", reason="sends itself a signal")
@pytest.mark.parametrize("clocked", [True, False])
def test_an_interrupt_that_comes_as_a_table_is_evaluated_ends_the_run(monkeypatch, clocked):
    """Python would raise it at the first instruction of the function that C calls, where ctypes drops it."""
    entries, kind = [], bound_functions._Call

    def entered(function):
        def enter(*arguments):
            entries.append(arguments[0])
            if len(entries) == 30:
                signal.raise_signal(signal.SIGINT)
            return function(*arguments)

        return kind(enter)

    def inside(u):
        return Lookup1D(breakpoints=[-2.0, 0.0, 2.0], values=[-1.0, 0.0, 3.0], name="table")(u)

    if clocked:
        diagram = Diagram("d", subsystem(sample_time=0.01, name="box")(inside)(Sine(frequency=1.0, name="source")))
    else:
        x = Integrator(initial_value=1.0, name="x")
        diagram = Diagram("d", x(-inside(x.y)))
    monkeypatch.setattr(bound_functions, "_Call", entered)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            diagram.simulate(10.0, step=0.01, solver="rk4", compile=False, **QUIET)
    finally:
        signal.signal(signal.SIGINT, before)
    assert len(entries) >= 30
