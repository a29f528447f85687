"""How fast a sweep is: python benchmarks/sweep.py [samples].

Experiment C of Fig. 3 with its FMU, 2 s a run, of which the last samples and the largest motor forces are kept. Two
parameters are spread over a Latin hypercube: one of the FMU, one of the controller. The columns are threads; the
smallest time of three sweeps counts, and they take turns. The set-up is what a run costs beyond its ticks: the time of
a sweep with runs of 2 ms. At the end some runs are compared with single ones, bit by bit.
"""

from __future__ import annotations

import os
import sys
import time

import numpy as np

from loopwright.diagrams import experiments, final, maximum

PARAMETERS = {"plant.coulomb_scale": (0.5, 1.5), "controller.admittance_perp.stiffness": (100.0, 300.0)}
KEPT = {"xi": final("xi"), "force": maximum("motor_force")}


def main(samples: int = 1000) -> int:
    """Print the table; 1 if a bit differs."""
    diagram = experiments.hand_guiding().diagram
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

    def sweep(duration: float, workers: int, count: int = samples):
        return diagram.sweep(
            PARAMETERS, duration, samples="latin", count=count, reduce=KEPT, workers=workers, progress=False
        )

    sweep(0.002, 1, 2)  # the compiler has its turn
    counts = sorted({1, min(2, cores), cores})
    best = dict.fromkeys(counts, float("inf"))
    short, busy, found = float("inf"), float("inf"), None
    for _ in range(3):
        for workers in counts:
            begun, used = time.perf_counter(), time.process_time()
            found = sweep(2.0, workers)
            best[workers] = min(best[workers], time.perf_counter() - begun)
            if workers == 1:
                busy = min(busy, time.process_time() - used)
        used = time.process_time()
        sweep(0.002, 1)
        short = min(short, time.process_time() - used)
    print(f"{samples} runs of 2 s, {cores} cores")
    print("threads   time, s   runs/s   µs of a tick   times one thread")
    for workers, elapsed in best.items():
        tick = elapsed / samples / 2000 * 1e6
        print(f"{workers:7}  {elapsed:8.2f}  {samples / elapsed:7.1f}  {tick:13.2f}  {best[1] / elapsed:17.2f}")
    print(f"processor time of a run {busy / samples * 1e3:.2f} ms, of its set-up {short / samples * 1e3:.2f} ms")
    begun = time.perf_counter()
    same = True
    for i in np.linspace(0, samples - 1, 5).astype(int):
        single = diagram.replace(found.samples[i].parameters).simulate(2.0, progress=False)
        same &= single["xi"][-1].tobytes() == found["xi"][i].tobytes()
        same &= single["motor_force"].max(axis=0).tobytes() == found["force"][i].tobytes()
    print(f"bits of single runs: {'the same' if same else 'they differ'} ({time.perf_counter() - begun:.1f} s for 5)")
    return 0 if same else 1


if __name__ == "__main__":
    raise SystemExit(main(*map(int, sys.argv[1:])))
