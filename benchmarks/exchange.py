"""CPU time of an event in model exchange, with its search and the restart of the solver, and of a tick: docs/fmus.md.

python benchmarks/exchange.py
"""

import tempfile
import time
from pathlib import Path

from loopwright.blocks import Gain
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


def main():
    """Measure, and print a table."""
    folder = Path(tempfile.mkdtemp())
    ball, mass = bouncing_ball.build(out=folder / "ball.fmu"), mass_spring_damper.build(out=folder / "mass.fmu")
    for isolate in (False, True):
        place = "in a process of its own" if isolate else "in this process"
        both = []
        for height in (0.05, 1e6):  # with impacts, and without
            start = {"height": height, "restitution": 1.0}
            plant = Fmu(ball, interface="model_exchange", name="ball", isolate=isolate, start=start)
            both.append(spend(Diagram("ball", plant()), 40.0, step=0.05))
        (bouncing, run), (falling, _) = both
        events = len(run.events)
        print(f"{place}: {1e6 * (bouncing - falling) / events:.0f} µs an impact, of {events}")

        @subsystem(sample_time=0.01)
        def controller(position):
            return Gain(gain=-50.0, name="k")(position)

        plant = Fmu(mass, interface="model_exchange", name="plant", isolate=isolate)
        diagram = Diagram("loop", plant(force=controller(plant.position)))
        short, long = (spend(diagram, duration)[0] for duration in (1.0, 11.0))
        print(
            f"{place}: {1e6 * (long - short) / 1000:.0f} µs a tick whose input jumps, with the integration to the next"
        )


if __name__ == "__main__":
    main()
