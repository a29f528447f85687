"""The loop over ticks, and between them."""

from .progress import Interrupted
from .run_options import RunKeywords, RunOptions
from .simulated_diagram import SimulatedDiagram
from .simulation import Simulation, simulate
from .start_at_point import apply_point, copy_states
from .view import SimulationView
from .workspace import Workspace

__all__ = [
    "Interrupted",
    "RunKeywords",
    "RunOptions",
    "SimulatedDiagram",
    "Simulation",
    "SimulationView",
    "Workspace",
    "apply_point",
    "copy_states",
    "simulate",
]
