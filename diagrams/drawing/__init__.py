"""Drawings of diagrams."""

from .drawing import Drawing, draw
from .drawing_layout import Net, arrange
from .live import Facts, RecordedSignal
from .order import Node, Pin
from .printer import printer

__all__ = [
    "Drawing",
    "Facts",
    "Net",
    "Node",
    "Pin",
    "RecordedSignal",
    "arrange",
    "draw",
    "printer",
]
