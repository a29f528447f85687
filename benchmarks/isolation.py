"""Cost of isolation: steps, evaluations and starts of an FMU in its own process, over those in this process.

    python benchmarks/isolation.py

The machine must be quiet, with two cores free, for the first line; ``taskset -c 0`` before it gives the numbers of one
core. Between two steps the caller works for some microseconds, as a controller does. The ticks are those of a whole
diagram, everything recorded.
"""

import argparse
import os
import time

import numpy as np

from loopwright.blocks.core import Wanted
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, mass_spring_damper
from loopwright.fmus.isolation import end_idle

NOW = time.perf_counter


def measure(call, count, work):
    """Return the times of calls in µs, with some seconds of work before each."""
    times = np.empty(count)
    for k in range(count):
        end = NOW() + work
        while NOW() < end:
            pass
        start = NOW()
        call(k)
        times[k] = NOW() - start
    return 1e6 * times


def steps(file, isolate, count, work):
    """Return the times of communication steps in µs."""
    block = Fmu(file, isolate=isolate)
    with block.instantiate([*block.inputs], None) as instance:
        instance.bind(np.ones(1), np.zeros(3))
        instance.exchange()
        instance.begin()
        return measure(lambda k: instance.step(1e-3 * k, 1e-3), count, work)


def evaluations(file, isolate, count, work):
    """Return the times of evaluations in model exchange in µs: derivatives and outputs."""
    block = Fmu(file, interface="model_exchange", isolate=isolate)
    with block.exchange([*block.inputs]) as instance:
        evaluate = instance.evaluation(Wanted((*block.outputs,), rates=True))
        x, u = np.zeros(2), np.ones(1)
        return measure(lambda k: evaluate(1e-3 * k, x, u), count, work)


def ticks(file, isolate, compiled, count):
    """Return the times of ticks of a loop at 1 kHz in µs: means over parts of a run, each of so many ticks."""

    @subsystem(sample_time=1e-3, name="controller")
    def controller(position):
        return 2.0 * (0.1 - position)

    plant = Fmu(file, name="plant", isolate=isolate)
    times = np.empty(10)
    with Diagram("loop", plant(force=controller(plant.position))).simulation(compile=compiled) as run:
        run.advance(0.5)
        for k in range(len(times)):
            began = NOW()
            run.advance(1e-3 * count)
            times[k] = (NOW() - began) / count
        assert run.run().tier == ("compiled" if compiled else "interpreted")
    return 1e6 * times


def start(file, isolate):
    """Return the time of loading, initializing and one step in ms."""
    block = Fmu(file, isolate=isolate)
    end_idle()
    began = NOW()
    with block.instantiate([*block.inputs], None) as instance:
        instance.bind(np.ones(1), np.zeros(3))
        instance.begin()
        instance.step(0.0, 1e-3)
        return 1e3 * (NOW() - began)


def tell(name, inside, outside):
    """Print a row: medians, and what isolation adds at the median and at the 99th percentile."""
    added = np.median(outside) - np.median(inside)
    late = np.percentile(outside, 99) - np.median(inside)
    medians = f"{np.median(inside):7.2f} {np.median(outside):9.2f}"
    print(f"{name:<36} {medians}  +{added:7.2f} at the median, +{late:7.2f} at p99")


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10000)
    count = parser.parse_args().count
    file = mass_spring_damper.build()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    print(f"cores: {cores}; times in µs       in process  isolated")
    for work in (5e-6, 30e-6, 200e-6):
        some = count if work < 1e-4 else count // 10
        tell(f"step, {1e6 * work:.0f} µs of work between", *(steps(file, i, some, work) for i in (False, True)))
    tell("evaluation in model exchange", *(evaluations(file, i, count, 5e-6) for i in (False, True)))
    for compiled in (False, True):
        name = f"tick of a loop, {'compiled' if compiled else 'interpreted'}"
        tell(name, *(ticks(file, i, compiled, max(count // 5, 100)) for i in (False, True)))
    inside, outside = ([start(file, isolate) for _ in range(5)] for isolate in (False, True))
    print(f"start to the first step in ms {np.median(inside):14.1f} {np.median(outside):9.1f}")


if __name__ == "__main__":
    main()
