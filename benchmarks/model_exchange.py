"""CPU time of an event in model exchange, with its search and the restart of the solver, and of a tick.

python benchmarks/model_exchange.py
"""

import tempfile
import time
import timeit
import zipfile
from pathlib import Path

import numpy as np

from loopwright.blocks import Gain
from loopwright.blocks.core import Wanted
from loopwright.diagrams import Diagram, subsystem
from loopwright.fmus import Fmu, bouncing_ball, mass_spring_damper


def spend(diagram, duration, **options):
    """Return the CPU seconds of a run, the least of three, and the run."""
    found = []
    for _ in range(3):
        start = time.process_time()
        run = diagram.simulate(duration, rtol=1e-8, atol=1e-10, progress=False, **options)
        found.append(time.process_time() - start)
    return min(found), run


def measure_impact(ball, *, isolate, form):
    """Return the CPU seconds of an impact, and the number of impacts."""
    both = []
    for height in (0.05, 1e6):  # with impacts, and without
        start = {"height": height, "restitution": 1.0}
        plant = Fmu(ball, interface="model_exchange", name="ball", isolate=isolate, start=start)
        both.append(spend(Diagram("ball", plant()), 40.0, step=0.05, compile=form))
    (bouncing, run), (falling, _) = both
    return (bouncing - falling) / len(run.events), len(run.events)


def measure_tick(mass, *, isolate, form):
    """Return the CPU seconds of a tick at which an input jumps, with the integration to the next one, and the tier."""

    @subsystem(sample_time=0.01)
    def controller(position):
        return Gain(gain=-50.0, name="k")(position)

    plant = Fmu(mass, interface="model_exchange", name="plant", isolate=isolate)
    diagram = Diagram("loop", plant(force=controller(plant.position)))
    count = 1_000 if not form else 10_000 if isolate else 100_000
    (short, _), (long, run) = (spend(diagram, duration, compile=form) for duration in (1.0, 1.0 + count / 100))
    return (long - short) / count, run.tier


def measure_evaluation(mass):
    """Return the wall-clock seconds of an evaluation in another process: of our own FMU, and of a copy from anywhere.

    The copy is asked in the longer order, as an FMU of another tool is.
    """
    copy = mass.with_name("foreign.fmu")
    with zipfile.ZipFile(mass) as old, zipfile.ZipFile(copy, "w") as new:
        for name in old.namelist():
            new.writestr(name, old.read(name))
    found = []
    for file in (mass, copy):
        plant = Fmu(file, interface="model_exchange", name="plant", isolate=True)
        with plant.exchange(["force"]) as instance:
            u = np.zeros(1)
            x = instance.exchange(u)
            instance.begin_exchange()
            call = instance.evaluation(Wanted(("position", "velocity", "acceleration"), rates=True))
            found.append(min(timeit.repeat(lambda: call(0.0, x, u), number=20, repeat=500)) / 20)  # noqa: B023
    return found


def main():
    """Measure, and print a table: interpreted, compiled, and how many times as fast that is."""
    folder = Path(tempfile.mkdtemp())
    ball, mass = bouncing_ball.build(out=folder / "ball.fmu"), mass_spring_damper.build(out=folder / "mass.fmu")
    print(f"{'':>34}  {'interpreted':>12}  {'compiled':>12}  ratio")
    for isolate in (False, True):
        place = "in its own process" if isolate else "in this process"
        impacts = [measure_impact(ball, isolate=isolate, form=form)[0] for form in (False, True)]
        ticks, tiers = zip(*(measure_tick(mass, isolate=isolate, form=form) for form in (False, True)), strict=True)
        for name, (before, after) in {"impact": impacts, "tick": ticks}.items():
            shown = f"{1e6 * before:9.1f} µs  {1e6 * after:9.1f} µs  {before / after:5.1f}"
            print(f"{name + ' ' + place:>34}  {shown if tiers[1] == 'compiled' else shown[:12] + '   not compiled'}")
    own, foreign = measure_evaluation(mass)
    print(f"evaluation in its own process: {1e6 * own:.1f} µs, of an FMU of another tool {1e6 * foreign:.1f} µs")


if __name__ == "__main__":
    main()
