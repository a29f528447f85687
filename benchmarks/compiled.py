"""How fast a loop runs, interpreted and compiled: python benchmarks/compiled.py.

The experiments of Fig. 3, everything recorded. A tick is timed on a run that goes on, so that neither the start nor the
compiler counts; each figure is the smallest of seven, the two forms take turns. The last column says whether all
samples have the same bits.
"""

from __future__ import annotations

import time

from loopwright.diagrams import experiments

TICKS = 4000


def main() -> int:
    """Print one row for each experiment; 1 if a bit differs."""
    print("experiment  interpreted, µs/tick   compiled, µs/tick   ratio   same bits")
    worst = 0
    for letter, make in experiments.EXPERIMENTS.items():
        diagram = make().diagram
        best, runs = {False: float("inf"), True: float("inf")}, {}
        with diagram.simulation() as first, diagram.simulation(compile=True) as second:
            simulations = {False: first, True: second}
            for _ in range(7):
                for form, simulation in simulations.items():
                    started = time.perf_counter()
                    simulation.advance(TICKS * 1e-3)
                    best[form] = min(best[form], time.perf_counter() - started)
                    runs[form] = simulation.run(final=False)
        same = runs[False].data.tobytes() == runs[True].data.tobytes()
        worst |= not same
        interpreted, compiled = (best[form] / TICKS * 1e6 for form in (False, True))
        print(f"{letter:10}  {interpreted:20.2f}  {compiled:18.2f}  {interpreted / compiled:6.2f}   {same}")
    return worst


if __name__ == "__main__":
    raise SystemExit(main())
