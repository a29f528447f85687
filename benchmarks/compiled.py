"""Time of a loop's tick, interpreted and compiled: python benchmarks/compiled.py.

The experiments of Fig. 3, everything recorded. A tick is timed on a run that goes on, so that neither the start nor the
compiler counts; each figure is the smallest of seven, the two forms take turns. The last column says whether all
samples have the same bits. Below: a PI controller at 1 kHz around two lags in continuous time, with solvers that start
anew at every tick, and its largest error against the exponential of a matrix.
"""

from __future__ import annotations

import time
from contextlib import ExitStack

import numpy as np
from scipy.linalg import expm

from loopwright.blocks import TransferFunction, UnitDelay
from loopwright.diagrams import Diagram, experiments, subsystem

TICKS, TURNS, LAG_TURNS = 4000, 7, 5
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
        for _ in range(LAG_TURNS):
            for simulation, (_, ticks), found in zip(simulations, forms, times, strict=True):
                started = time.thread_time()
                simulation.advance(ticks * 1e-3)
                found.append((time.thread_time() - started) / ticks)
                simulation.run(final=False)
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


def main() -> int:
    """Print one row for each experiment, and one for each solver of a continuous plant; 1 if a bit differs."""
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
    return worst


if __name__ == "__main__":
    raise SystemExit(main())
