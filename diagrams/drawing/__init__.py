"""Drawings of diagrams."""

from .drawing import Drawing
from .printer import printer
from .svg import draw

__all__ = [
    "Drawing",
    "draw",
    "printer",
]
