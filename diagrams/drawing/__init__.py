"""Drawings of diagrams."""

from .box_order import Node, Pin
from .drawing import Drawing, draw
from .drawing_layout import Net, arrange
from .live import Facts, RecordedSignal
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
