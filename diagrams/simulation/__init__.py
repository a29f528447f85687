"""The loop over ticks, and between them."""

from .algebraic_loops import newton_options
from .diagnosis import START_SETTLED
from .engine import Engine
from .held_inputs import note_held_inputs
from .initialize import find_initial_state, find_start_values, values_from_left
from .progress import Interrupted, late_progress, progress_bar
from .run_options import START_EXCHANGES, KeptKeywords, RunKeywords, RunOptions, default_step, refuse_rest, ticks_in
from .simulated_diagram import SimulatedDiagram
from .simulation import Simulation, simulate
from .start_at_point import apply_point, copy_states
from .stops import StopConditions
from .view import SimulationView
from .workspace import Workspace

__all__ = [
    "START_EXCHANGES",
    "START_SETTLED",
    "Engine",
    "Interrupted",
    "KeptKeywords",
    "RunKeywords",
    "RunOptions",
    "SimulatedDiagram",
    "Simulation",
    "SimulationView",
    "StopConditions",
    "Workspace",
    "apply_point",
    "copy_states",
    "default_step",
    "find_initial_state",
    "find_start_values",
    "late_progress",
    "newton_options",
    "note_held_inputs",
    "progress_bar",
    "refuse_rest",
    "simulate",
    "ticks_in",
    "values_from_left",
]
