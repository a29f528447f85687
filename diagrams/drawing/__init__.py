"""Drawings of diagrams."""

from .drawing import Drawing, draw
from .drawing_layout import Net, arrange
from .layers import Node, Pin
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
