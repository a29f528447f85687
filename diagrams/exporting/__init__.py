"""Diagrams as they leave: a diagram or a subsystem as a plain value, of which FMUs, C and web pages are made."""

from .loop_of_diagram import loop_spec
from .make_exported import make_exported, name_of
from .open_diagram import let_move, open_part, open_subsystem, open_whole
from .plants_to_merge import own_fmus
from .target import target_spec, to_c

__all__ = [
    "let_move",
    "loop_spec",
    "make_exported",
    "name_of",
    "open_part",
    "open_subsystem",
    "open_whole",
    "own_fmus",
    "target_spec",
    "to_c",
]
