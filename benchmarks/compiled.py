"""Time of a loop's tick, interpreted and compiled: python benchmarks/compiled.py.

The experiments of Fig. 3, everything recorded. A tick is timed on a run that continues, so that neither the start nor
the compiler counts; each figure is the smallest of seven, the two forms take turns. The last column says whether all
samples have the same bits. Below: a PI controller at 1 kHz around two lags in continuous time, with solvers that start
again at every tick, and its largest error against the exponential of a matrix. Last: large diagrams, whose blocks are
evaluated kind by kind, with one signal recorded, and the time until their first tick.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np
from scipy.linalg import expm

from loopwright.blocks import PID, Gain, Sine, Sum, TransferFunction, UnitDelay
from loopwright.diagrams import Diagram, experiments, subsystem

TICKS, TURNS, LAG_TURNS = 4000, 7, 5
LARGE_TICKS = 400
SOLVERS = ("rk4", "RK45", "auto", "Radau")


def lags() -> Diagram:
    """A PI controller at 1 kHz around two lags."""

    @subsystem(sample_time=1e-3, name="controller")
    def controller(y):
        error = 1.0 - y
        memory = UnitDelay(initial_value=0.0, name="integral")
        return 2.0 * error + 5.0 * memory(memory.y + 1e-3 * error)

    first = TransferFunction(numerator=1.0, denominator=[0.05, 1.0], name="first")
    second = TransferFunction(numerator=1.0, denominator=[0.02, 1.0], name="second")
    return Diagram("loop", second(first(controller(second.y))))


def exact_lags(ticks: int) -> np.ndarray:
    """Return the output of that loop at its ticks."""
    A = np.array([[-20.0, 0.0], [50.0, -50.0]])
    step = expm(1e-3 * np.vstack([np.hstack([A, [[20.0], [0.0]]]), np.zeros((1, 3))]))
    x, integral, found = np.zeros(2), 0.0, []
    for _ in range(ticks + 1):
        found.append(x[1])
        error = 1.0 - x[1]
        x, integral = step[:2, :2] @ x + step[:2, 2] * (2.0 * error + 5.0 * integral), integral + 1e-3 * error
    return np.array(found)


def measure_lags(solver: str) -> tuple[list[float], list[float], list[float]]:
    """Return the times of ticks in s, interpreted and compiled, turn by turn, and the largest error of each form."""
    diagram, errors = lags(), []
    times: list[list[float]] = [[], []]
    forms = ((False, 1000), (True, 100_000))
    for form, _ in forms:
        run = diagram.simulate(1.0, solver=solver, compile=form, progress=False)
        errors.append(float(np.max(np.abs(run["second.y"] - exact_lags(1000)))))
    with ExitStack() as stack:
        simulations = [stack.enter_context(diagram.simulation(solver=solver, compile=form)) for form, _ in forms]
        for simulation in simulations:
            simulation.advance(0.1)
        kept = {}  # the last run of each: its memory, given back to the system, would be paged in again by the next one
        for _ in range(LAG_TURNS):
            for simulation, (_, ticks), found in zip(simulations, forms, times, strict=True):
                started = time.thread_time()
                simulation.advance(ticks * 1e-3)
                found.append((time.thread_time() - started) / ticks)
                kept[simulation] = simulation.run(final=False)
    return times[0], times[1], errors


def measure_experiment(letter: str) -> tuple[list[float], list[float], bool]:
    """Return the times of ticks in s, interpreted and compiled, turn by turn, and whether all bits are the same."""
    diagram = experiments.EXPERIMENTS[letter]().diagram
    times: dict[bool, list[float]] = {False: [], True: []}
    runs = {}
    with diagram.simulation(compile=False) as first, diagram.simulation(compile=True) as second:
        simulations = {False: first, True: second}
        for _ in range(TURNS):
            for form, simulation in simulations.items():
                started = time.perf_counter()
                simulation.advance(TICKS * 1e-3)
                times[form].append((time.perf_counter() - started) / TICKS)
                runs[form] = simulation.run(final=False)
    return times[False], times[True], runs[False].data.tobytes() == runs[True].data.tobytes()


def chain_of_gains(n: int) -> Diagram:
    """Gains and delays in turn, at 100 Hz: runs of one block each, the least that can be done together."""

    @subsystem(sample_time=0.01, name="box")
    def box(signal):
        for i in range(n):
            kind = UnitDelay(initial_value=0.0, name=f"b{i}") if i % 2 else Gain(gain=1.0 - 1e-3 * i, name=f"b{i}")
            signal = kind(signal)
        return signal

    return Diagram("chain", box(Sine(frequency=3.0, name="source")))


def pid_loops(n: int) -> Diagram:
    """Controllers of lags at 100 Hz, next to each other."""

    @subsystem(sample_time=0.01, name="box")
    def box(signal):
        lags = [TransferFunction(numerator=1.0, denominator=[0.5 + 1e-3 * i, 1.0], name=f"lag{i}") for i in range(n)]
        for i, lag in enumerate(lags):
            lag(PID(kp=2.0, ki=1.0, kd=0.05, filter_time=0.1, name=f"pid{i}")(signal, lag.y))
        return lags[0].y

    return Diagram("loops", box(Sine(frequency=0.3, name="source")))


def ring_of_lags(n: int) -> Diagram:
    """Lags in continuous time, each driven by the difference of two others."""
    lags = [TransferFunction(numerator=1.0, denominator=[1.0, 1.0], name=f"x{i}") for i in range(n)]
    calls = []
    for i, lag in enumerate(lags):
        total = Sum(signs="+-", name=f"s{i}")(lags[(i + 1) % n].y, lags[(7 * i + 3) % n].y)
        calls.append(lag(Gain(gain=0.3, name=f"g{i}")(total)))
    return Diagram("ring", *calls)


def measure_large(make: Callable[[int], Diagram], n: int, **options: Any) -> tuple[list[float], list[float]]:
    """Return the times of ticks in s, and those until the first one, by the virtual machine and by generated code."""
    ticks, starts = [], []
    make(n).simulate(0.1, compile=True, progress=False, **options)  # the cache has the code
    for form in (False, True):
        diagram = make(n)
        started = time.process_time()
        with diagram.simulation(compile=form, **options) as simulation:
            step = float(simulation.flat.base)
            simulation.advance(step)
            starts.append(time.process_time() - started)
            found = []
            for _ in range(TURNS):
                started = time.process_time()
                simulation.advance(LARGE_TICKS * step)
                found.append((time.process_time() - started) / LARGE_TICKS)
            ticks.append(min(found))
    return ticks, starts


def main() -> int:
    """Print rows for experiments, for solvers of a continuous plant, and for large diagrams; 1 if a bit differs."""
    print("experiment  interpreted, µs/tick   compiled, µs/tick   ratio   same bits")
    worst = 0
    for letter in experiments.EXPERIMENTS:
        *times, same = measure_experiment(letter)
        worst |= not same
        interpreted, compiled = (min(found) * 1e6 for found in times)
        print(f"{letter:10}  {interpreted:20.2f}  {compiled:18.2f}  {interpreted / compiled:6.2f}   {same}")
    print("\nsolver      interpreted, µs/tick   compiled, µs/tick   ratio   error interpreted   compiled")
    for solver in SOLVERS:
        *times, errors = measure_lags(solver)
        interpreted, compiled = (min(found) * 1e6 for found in times)
        print(
            f"{solver:10}  {interpreted:20.2f}  {compiled:18.2f}  {interpreted / compiled:6.0f}   {errors[0]:17.1e}  "
            f"{errors[1]:9.1e}"
        )
    print("\nlarge diagram            interpreted, µs/tick   compiled, µs/tick   ratio   first tick, s   compiled")
    rk4 = {"step": 1e-3, "solver": "rk4", "record": ["x0"]}
    for name, make, n, options in (
        ("300 PID loops", pid_loops, 300, {"record": ["source"]}),
        ("chain of 3000 blocks", chain_of_gains, 3000, {"record": ["source"]}),
        ("600 lags, rk4", ring_of_lags, 600, rk4),
    ):
        (interpreted, compiled), (first, second) = measure_large(make, n, **options)
        print(
            f"{name:23}  {interpreted * 1e6:20.2f}  {compiled * 1e6:18.2f}  {interpreted / compiled:6.1f}  "
            f"{first:14.2f}  {second:9.2f}"
        )
    return worst


if __name__ == "__main__":
    raise SystemExit(main())
