"""Planar paths: ellipse, circle, line, cubic spline, and the base of users' own paths."""

from .curve import Frame
from .path import Path
from .reach import UNLIMITED, replace_unlimited
from .shapes import Circle, Ellipse, Line
from .spline import CubicSpline

__all__ = [
    "UNLIMITED",
    "Circle",
    "CubicSpline",
    "Ellipse",
    "Frame",
    "Line",
    "Path",
    "replace_unlimited",
]
