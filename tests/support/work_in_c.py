"""What a run in C has done for its solver."""

from typing import NamedTuple


class Work(NamedTuple):
    """Steps that were taken and rejected, and evaluations of the rates and of their Jacobian."""

    steps: int
    rejected: int
    rates: int
    slopes: int


def simulate_counted(diagram, duration, **options):
    """Return a run, and the work of its solver."""
    with diagram.simulation(**options) as simulation:
        simulation.advance(duration)
        return simulation.run(), Work(*simulation._engine._ticks._loop.counts)
