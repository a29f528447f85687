"""Drawings of diagrams."""

from .svg import Drawing, draw

__all__ = [
    "Drawing",
    "draw",
]
