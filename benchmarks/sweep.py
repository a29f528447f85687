"""How fast a sweep is: python benchmarks/sweep.py [samples].

Experiment C of Fig. 3 with its FMU, 2 s a run, of which the last samples and the largest motor forces are kept. Two
parameters are spread over a Latin hypercube: one of the FMU, one of the controller. The rows are runs one after the
other and side by side in vector lanes, with one thread and with several; the smallest time of three sweeps counts, and
they take turns. The set-up is what a run costs beyond its ticks: the processor time of a sweep with runs of 2 ms.

The last column is the throughput of a core and that of the C by hand of `handwritten.py`, which takes 4 substeps and
1 projection and records nothing, where these runs take 5 and 2 and keep two signals: its time for as many ticks, over
the time of a run times the threads. At the end some runs are compared with single ones: bit by bit, and in lanes to
1e-10 of the largest value. The program ends with status 1 if they differ by more.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from handwritten import FORMS, TICKS, compile_by_hand, run_by_hand

from loopwright.diagrams import experiments
from loopwright.sweeps import final, maximum

PARAMETERS = {"plant.coulomb_scale": (0.5, 1.5), "controller.admittance_perp.stiffness": (100.0, 300.0)}
KEPT = {"xi": final("xi"), "force": maximum("motor_force")}
SECONDS, RUN_TICKS = 2.0, 2000
LANES = {"one by one": False, "4 lanes": 4, "8 lanes": 8, "16 lanes": 16}
BOUND = 1e-10
TURNS = 3
CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def time_by_hand(library) -> float:
    """Return the seconds that the C by hand takes for the ticks of a run: the smallest of 10 times."""
    rows, (form, *_) = np.zeros((TICKS + 1, 57)), FORMS.values()
    return min(run_by_hand(library, form, rows) for _ in range(10)) * RUN_TICKS / TICKS


def compare(diagram, found) -> dict[str, float]:
    """Return the largest differences of some runs from single ones, relative to the signals' largest values."""
    worst = dict.fromkeys(found, 0.0)
    some = next(iter(found.values()))
    for i in np.linspace(0, len(some.samples) - 1, 5).astype(int):
        single = diagram.replace(some.samples[i].parameters).simulate(SECONDS, progress=False)
        wanted = {"xi": single["xi"][-1], "force": single["motor_force"].max(axis=0)}
        for form, sweep in found.items():
            for name, value in wanted.items():
                difference = np.abs(sweep[name][i] - value).max() / max(np.abs(value).max(), 1e-3)
                worst[form] = max(worst[form], float(difference))
    return worst


@dataclass(frozen=True)
class Measured:
    """Seconds of sweeps, turn by turn, by form and threads; processor time; time of the C by hand; differences."""

    by_hand: list[float]
    elapsed: dict[tuple[str, int], list[float]]
    busy: dict[str, float]
    short: dict[str, float]
    differences: dict[str, float]


def measure(samples: int, *, shown: bool = True) -> Measured:
    """Let all forms take turns; tell the compiler of the C by hand."""
    diagram = experiments.hand_guiding().diagram
    with tempfile.TemporaryDirectory() as folder:
        library, _ = compile_by_hand(Path(folder), shown=shown)

    def sweep(duration: float, workers: int, lanes: bool | int, count: int = samples):
        return diagram.sweep(
            PARAMETERS,
            duration,
            samples="latin",
            count=count,
            reduce=KEPT,
            workers=workers,
            lanes=lanes,
            progress=False,
        )

    for lanes in LANES.values():  # the compiler has its turn
        sweep(0.002, 1, lanes, 2)
    counts = sorted({1, min(2, CORES), CORES})
    elapsed: dict[tuple[str, int], list[float]] = {(form, workers): [] for form in LANES for workers in counts}
    busy, short = dict.fromkeys(LANES, float("inf")), dict.fromkeys(LANES, float("inf"))
    found, by_hand = {}, []
    for _ in range(TURNS):
        by_hand.append(time_by_hand(library))
        for form, lanes in LANES.items():
            for workers in counts:
                begun, used = time.perf_counter(), time.process_time()
                found[form] = sweep(SECONDS, workers, lanes)
                elapsed[form, workers].append(time.perf_counter() - begun)
                if workers == 1:
                    busy[form] = min(busy[form], time.process_time() - used)
            used = time.process_time()
            sweep(0.002, 1, lanes)
            short[form] = min(short[form], time.process_time() - used)
    return Measured(by_hand, elapsed, busy, short, compare(diagram, found))


def main(samples: int = 1000) -> int:
    """Print the table; 1 if a run differs from a single one by more than it may."""
    found = measure(samples)
    by_hand = min(found.by_hand)
    print(f"{samples} runs of {SECONDS:g} s, {CORES} cores; C by hand takes {by_hand * 1e3:.2f} ms for as many ticks")
    print(f"{'runs':>12} threads   time, s   runs/s   ns of a tick   times one thread   a core next to C by hand")
    best = {key: min(times) for key, times in found.elapsed.items()}
    for (form, workers), elapsed in best.items():
        run = elapsed / samples
        print(
            f"{form:>12} {workers:7}  {elapsed:8.2f}  {1 / run:7.1f}  {run / RUN_TICKS * 1e9:13.0f}"
            f"  {best[form, 1] / elapsed:17.2f}  {by_hand / (run * workers):24.2f}"
        )
    for form in LANES:
        ticks = (found.busy[form] - found.short[form]) / samples
        print(
            f"{form:>12}: processor time of a run {found.busy[form] / samples * 1e3:.2f} ms, of its set-up "
            f"{found.short[form] / samples * 1e3:.2f} ms, of a tick {ticks / RUN_TICKS * 1e9:.0f} ns"
        )
    texts = (f"{form} {value:.1e}" for form, value in found.differences.items())
    print("largest difference from single runs: " + ", ".join(texts))
    return 0 if is_right(found.differences) else 1


def is_right(differences: dict[str, float]) -> bool:
    """Whether no run differs from a single one by more than it may."""
    return all(value == 0.0 if not LANES[form] else value < BOUND for form, value in differences.items())


if __name__ == "__main__":
    raise SystemExit(main(*map(int, sys.argv[1:])))
