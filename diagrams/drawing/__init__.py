"""Drawings of diagrams."""

from .drawing import Drawing, draw
from .live import Facts, RecordedSignal
from .printer import printer

__all__ = [
    "Drawing",
    "Facts",
    "RecordedSignal",
    "draw",
    "printer",
]
