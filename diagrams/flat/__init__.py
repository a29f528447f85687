"""A whole diagram as functions of (t, x, w, p)."""

from ...blocks.core import Layout
from .evaluation import Apart, Instant, evaluate
from .flat_diagram import FlatDiagram
from .functions import indicators_of
from .layout import NONE, FlatEvent, StateLayout, TickPattern
from .logic import TRUE, is_true
from .stages import Bound, Evaluators, Schedule, evaluate_apart
from .total_derivative import Derivative
from .trace_stages import trace_schedule
from .vectors import join_columns, loop_mismatch, next_x, plant_inputs, rates
from .wired_diagram import WiredDiagram

__all__ = [
    "NONE",
    "TRUE",
    "Apart",
    "Bound",
    "Derivative",
    "Evaluators",
    "FlatDiagram",
    "FlatEvent",
    "Instant",
    "Layout",
    "Schedule",
    "StateLayout",
    "TickPattern",
    "WiredDiagram",
    "evaluate",
    "evaluate_apart",
    "indicators_of",
    "is_true",
    "join_columns",
    "loop_mismatch",
    "next_x",
    "plant_inputs",
    "rates",
    "trace_schedule",
]
