"""A whole run in one call."""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING, Any

from .duration import ticks_in
from .progress import progress_bar
from .simulation import Simulation

if TYPE_CHECKING:
    from ..diagram import Diagram
    from ..linearization.operating_point import OperatingPoint
    from ..results.run import Run
    from ..results.saved_state import RunState


def simulate(
    diagram: Diagram, duration: Any, *, progress: bool | None, start: RunState | OperatingPoint | None, **options: Any
) -> Run:
    """Run a diagram; see `Diagram.simulate`."""
    if duration is None:
        ticks_in(duration, Fraction(1), diagram.name)  # refused
    with Simulation(diagram, duration=duration, start=start, **options) as simulation:
        first = simulation.t
        with progress_bar(diagram.name, first, first + float(duration), progress) as show:
            if simulation.stopped is None:
                simulation.advance(duration, progress=show)
        return simulation.run()
