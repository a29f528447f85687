"""Drawings of diagrams."""

from .drawing import Drawing, draw, printer
from .drawing_layout import Net, arrange
from .layers import Node, Pin
from .live import Facts, RecordedSignal

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
