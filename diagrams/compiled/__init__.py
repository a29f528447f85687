"""The compiled loop: C code of a diagram's ticks, and the master that goes over them."""

from .code import TickCode, compile_ticks, find_obstacle
from .loop import CompiledLoop, Outcome, Reason

__all__ = [
    "CompiledLoop",
    "Outcome",
    "Reason",
    "TickCode",
    "compile_ticks",
    "find_obstacle",
]
