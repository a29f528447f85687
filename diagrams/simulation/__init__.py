"""The loop over ticks, and between them."""

from .algebraic_loops import newton_options
from .block_start_values import (
    Port,
    StartFunctions,
    TracedStartValues,
    find_initial_state,
    find_start_values,
    trace_start,
    values_from_left,
)
from .bound_loops import bind_hybrid, bind_ticks
from .continuous import Continuous, find_late, next_instant
from .engine import Engine
from .failed_blocks import START_SETTLED
from .held_inputs import note_held_inputs
from .initialize import Initialization
from .live_run import LiveRun
from .progress import Interrupted, ProgressOption, late_progress, progress_bar, work_notes
from .run_options import START_EXCHANGES, KeptKeywords, RunKeywords, RunOptions, default_step, refuse_rest, ticks_in
from .simulation import Simulation, simulate
from .start_at_point import apply_point, copy_states
from .stops import StopConditions
from .view import SimulationView
from .workspace import Workspace

__all__ = [
    "START_EXCHANGES",
    "START_SETTLED",
    "Continuous",
    "Engine",
    "Initialization",
    "Interrupted",
    "KeptKeywords",
    "LiveRun",
    "Port",
    "ProgressOption",
    "RunKeywords",
    "RunOptions",
    "Simulation",
    "SimulationView",
    "StartFunctions",
    "StopConditions",
    "TracedStartValues",
    "Workspace",
    "apply_point",
    "bind_hybrid",
    "bind_ticks",
    "copy_states",
    "default_step",
    "find_initial_state",
    "find_late",
    "find_start_values",
    "late_progress",
    "newton_options",
    "next_instant",
    "note_held_inputs",
    "progress_bar",
    "refuse_rest",
    "simulate",
    "ticks_in",
    "trace_start",
    "values_from_left",
    "work_notes",
]
