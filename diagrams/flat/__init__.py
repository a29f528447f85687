"""A whole diagram as functions of (t, x, w, p)."""

from ...blocks.core import Layout
from .announced import Announcer, Times, announcers
from .clock_sets import bits_of, has_all_kinds, kinds_of, times_of
from .clocks import EVERY, NONE, ClockSets, TickPattern, ticks_after
from .enabling_and_triggers import TRUE, is_true
from .evaluation import JUMP, Apart, Instant, evaluate, just_after, no_evaluator, sort_names
from .fast_functions import share_terms, speed_up
from .flat_diagram import FlatDiagram
from .flat_functions import indicators_of, trace_guarded_tick
from .flat_layout import FlatEvent, StateLayout, sample_time_of
from .flatten import flatten, renumber, write_numbers
from .movable import Target, find_movable, with_movable
from .plant_ticks import StepTable, own_step, takes_any_step
from .program import AND, CHOOSE, COPY, LESS, NOT, OR, TRUE_OF, Ids, Operation, PartProgram, Program, TickProgram
from .stages import Bound, Evaluator, Evaluators, OpaqueStage, Schedule, bind_function, evaluate_apart
from .total_derivative import Derivative, size_of_motion
from .trace_stages import trace_schedule
from .vectors import Vectors, join_columns, loop_mismatch, next_x, plant_inputs, rates
from .wired_diagram import WiredDiagram

__all__ = [
    "AND",
    "CHOOSE",
    "COPY",
    "EVERY",
    "JUMP",
    "LESS",
    "NONE",
    "NOT",
    "OR",
    "TRUE",
    "TRUE_OF",
    "Announcer",
    "Apart",
    "Bound",
    "ClockSets",
    "Derivative",
    "Evaluator",
    "Evaluators",
    "FlatDiagram",
    "FlatEvent",
    "Ids",
    "Instant",
    "Layout",
    "OpaqueStage",
    "Operation",
    "PartProgram",
    "Program",
    "Schedule",
    "StateLayout",
    "StepTable",
    "Target",
    "TickPattern",
    "TickProgram",
    "Times",
    "Vectors",
    "WiredDiagram",
    "announcers",
    "bind_function",
    "bits_of",
    "evaluate",
    "evaluate_apart",
    "find_movable",
    "flatten",
    "has_all_kinds",
    "indicators_of",
    "is_true",
    "join_columns",
    "just_after",
    "kinds_of",
    "loop_mismatch",
    "next_x",
    "no_evaluator",
    "own_step",
    "plant_inputs",
    "rates",
    "renumber",
    "sample_time_of",
    "share_terms",
    "size_of_motion",
    "sort_names",
    "speed_up",
    "takes_any_step",
    "ticks_after",
    "times_of",
    "trace_guarded_tick",
    "trace_schedule",
    "with_movable",
    "write_numbers",
]
