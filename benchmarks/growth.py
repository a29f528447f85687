"""How costs grow: python benchmarks/growth.py [picture.png].

Four panels: a tick and the compilation over the number of blocks (a chain of gains and delays), ticks over the number
of FMUs (motors, each with its own controller, 1 kHz), the throughput of a sweep over threads and vector lanes
(experiment C of Fig. 3, 2 s a run), and events over the number of bouncing balls in one diagram. Each in the compiled
and, where it says so, in the interpreted form; everything is recorded, but in the chain and in the sweep, which keep
one signal, and one number of each run. Times of one thread are the processor's, those of a sweep are elapsed; the
smallest of a few counts. The numbers are printed, too. The plot goes to benchmarks/out/growth.png, or to the picture
that is named; benchmarks/images/growth.png is one such.
"""

from __future__ import annotations

import math
import os
import sys
import time
from pathlib import Path

from scaling import chain, measured_in_c, seconds

from loopwright.blocks import Block, Constant, Event, Gain, Integrator, State, parameter
from loopwright.diagrams import Diagram, experiments, subsystem
from loopwright.fmus import Fmu, dc_motor
from loopwright.sweeps import final

BLOCKS = (10, 30, 100, 300, 1000, 3000, 10000)
FMUS = (1, 2, 4, 8, 16, 32, 64)
BALLS = (1, 2, 4, 8, 16, 32)
LANES = (1, 4, 8, 16)
SAMPLES = 320
FORMS = {"compiled": True, "interpreted": False}


class Ball(Block):
    """A ball that loses no energy."""

    height = State(start="start", output=True)
    speed = State()
    impact = Event("falling")
    start: float = parameter(default=1.0)

    def derivative(self, t, x, u):
        return x.speed, -9.81 + 0.0 * t

    def indicators(self, t, x, u):
        return x.height

    def jump(self, t, x, u, fired):
        return 0.0 * x.height, -x.speed


def motors(count: int) -> Diagram:
    """Motors as FMUs, each with its own sampled controller."""
    file, results = dc_motor.build(), []
    for k in range(count):
        motor = Fmu(file, name=f"motor{k}", ports=("voltage", "speed"))

        @subsystem(sample_time=1e-3, name=f"controller{k}")
        def controller(e):
            return Gain(gain=0.5, name="kp")(e) + Integrator(name="ki")(2.0 * e)

        results.append(motor(controller(Constant(value=10.0 + k) - motor.speed)))
    return Diagram("motors", *results)


def over_blocks() -> dict[str, list[float]]:
    """Return ns a block and tick, and s to compile."""
    found = [measured_in_c(chain, n, sampled=True) for n in BLOCKS]
    return {
        "tick": [step / n * 1e9 for n, (_, step, *_) in zip(BLOCKS, found, strict=True)],
        "compile": [compiling for compiling, *_ in found],
    }


def over_fmus() -> dict[str, list[float]]:
    """Return ticks a second by form."""
    found: dict[str, list[float]] = {form: [] for form in FORMS}
    for count in FMUS:
        diagram = motors(count)
        for form, compiled in FORMS.items():
            ticks = (20000 if compiled else 2000) // count
            with diagram.simulation(compile=compiled) as simulation:
                simulation.advance(ticks * 1e-3)
                found[form].append(ticks / seconds(lambda: simulation.advance(ticks * 1e-3)))  # noqa: B023
    return found


def over_lanes() -> dict[str, list[float]]:
    """Return runs a second over `LANES`, by the number of threads."""
    diagram = experiments.hand_guiding().diagram
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    parameters = {"plant.coulomb_scale": (0.5, 1.5), "admittance_perp.stiffness": (100.0, 300.0)}

    def sweep(lanes: int, workers: int, count: int) -> float:
        started = time.perf_counter()
        diagram.sweep(
            parameters,
            2.0,
            samples="latin",
            count=count,
            reduce={"xi": final("xi")},
            workers=workers,
            lanes=lanes if lanes > 1 else False,
            progress=False,
        )
        return time.perf_counter() - started

    found = {}
    for workers in sorted({1, min(2, cores), cores}):
        rows = []
        for lanes in LANES:
            sweep(lanes, workers, lanes)  # the compiler has its turn
            rows.append(SAMPLES / min(sweep(lanes, workers, SAMPLES) for _ in range(3)))
        found[f"{workers} thread{'s' * (workers > 1)}"] = rows
    return found


def over_balls() -> dict[str, list[float]]:
    """Return events a second by form; the balls bounce at their own times."""
    found: dict[str, list[float]] = {form: [] for form in FORMS}
    for count in BALLS:
        balls = [Ball(start=1.0 + 0.37 * k / count, name=f"ball{k}") for k in range(count)]
        diagram = Diagram("balls", *balls)
        for form, compiled in FORMS.items():
            duration = 20.0 if compiled else 2.0
            with diagram.simulation(compile=compiled, step=0.1) as simulation:
                simulation.advance(duration)
                simulation.run(final=False)
                elapsed = seconds(lambda: simulation.advance(duration))  # noqa: B023
                events = len(simulation.run(final=False).events) / 3
            found[form].append(events / elapsed)
    return found


def plot(results: dict[str, dict[str, list[float]]], path: Path) -> None:
    """Draw the four panels."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, ((blocks, fmus), (lanes, balls)) = plt.subplots(2, 2, figsize=(9, 6.4), layout="constrained")
    blocks.loglog(BLOCKS, results["blocks"]["tick"], "o-", color="C0")
    blocks.set(title="a chain in C", xlabel="blocks", ylim=(1, 100))
    blocks.set_ylabel("time of a tick, ns a block", color="C0")
    compiling = blocks.twinx()
    compiling.loglog(BLOCKS, results["blocks"]["compile"], "s--", color="C1")
    compiling.set_ylabel("compile, s", color="C1")
    compiling.set_ylim(1e-4, 10)
    for axis, places, key, title, label, unit in (
        (fmus, FMUS, "fmus", "FMUs with controllers at 1 kHz", "FMUs", "ticks a second"),
        (lanes, LANES, "lanes", "a sweep of experiment C, 2 s a run", "vector lanes (1: none)", "runs a second"),
        (balls, BALLS, "balls", "bouncing balls", "balls", "events a second"),
    ):
        for marker, (name, values) in zip(("o-", "s--", "^:"), results[key].items(), strict=False):
            axis.loglog(places, values, marker, label=name)
        axis.set(title=title, xlabel=label, ylabel=unit)
        axis.legend()
    for axis, key in ((lanes, "lanes"), (balls, "balls")):  # whole decades
        low, high = (of(map(of, results[key].values())) for of in (min, max))
        axis.set_ylim(10.0 ** math.floor(math.log10(low)), 10.0 ** math.ceil(math.log10(high)))
    for axis, places in ((fmus, FMUS), (lanes, LANES), (balls, BALLS)):
        axis.set_xticks(places, [str(place) for place in places])
        axis.minorticks_off()
    for axis in (blocks, fmus, lanes, balls):
        axis.grid(visible=True, which="major", alpha=0.3)
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=130)


def main() -> int:
    """Print the numbers, and draw them."""
    results = {}
    panels = {
        "blocks": (over_blocks, BLOCKS, "ns a block and tick; s to compile"),
        "fmus": (over_fmus, FMUS, "ticks a second"),
        "lanes": (over_lanes, LANES, "runs a second"),
        "balls": (over_balls, BALLS, "events a second"),
    }
    for key, (measure, places, unit) in panels.items():
        results[key] = measure()
        print(f"\n{unit}, over {key}\n{'':14}" + "".join(f"{place:>12}" for place in places))
        for name, values in results[key].items():
            print(f"{name:14}" + "".join(f"{value:12.4g}" for value in values), flush=True)
    plot(results, Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "out" / "growth.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
