"""How fast a loop runs: python benchmarks/speed.py.

Each figure is the median of five, after one warm run. The real-time factor is simulated over elapsed time of the whole
`simulate` call. The share of the FMU is measured by stepping it alone, through the same interface.
"""

from __future__ import annotations

import statistics
import time

import numpy as np

from loopwright.diagrams import experiments


def seconds(action, runs: int = 5) -> float:
    """Return the median duration of a call."""
    action()
    durations = []
    for _ in range(runs):
        started = time.perf_counter()
        action()
        durations.append(time.perf_counter() - started)
    return statistics.median(durations)


def plant_alone(plant, ticks: int) -> float:
    """Return the seconds that the FMU takes for its steps alone."""
    with plant.instantiate(list(plant.inputs), 1e3) as instance:
        inputs, outputs = np.zeros(4), np.zeros(6)
        instance.bind(inputs, outputs)
        instance.begin()
        inputs[:2] = 70.0, 80.0
        started = time.perf_counter()
        for k in range(ticks):
            instance.step(k * 1e-3, 1e-3)
        return time.perf_counter() - started


def main() -> None:
    """Print one row for each experiment."""
    print("experiment  ticks   s/run   times real time   µs/tick   FMU alone, µs/tick   build, ms")
    for letter, make in experiments.EXPERIMENTS.items():
        started = time.perf_counter()
        experiment = make()
        build = time.perf_counter() - started
        ticks = round(experiment.duration * 1000)
        whole = seconds(lambda e=experiment: e.simulate(progress=False))
        alone = seconds(lambda e=experiment, n=ticks: plant_alone(e.diagram["plant"], n))
        print(
            f"{letter:10}  {ticks:5}  {whole:6.3f}  {experiment.duration / whole:16.0f}  {whole / ticks * 1e6:8.2f}"
            f"  {alone / ticks * 1e6:19.2f}  {build * 1e3:10.0f}"
        )


if __name__ == "__main__":
    main()
