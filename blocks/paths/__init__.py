"""Planar paths: ellipse, circle, line, cubic spline, and the base for paths of one's own."""

from __future__ import annotations

from .path import UNLIMITED, Frame, Path
from .shapes import Circle, Ellipse, Line
from .spline import CubicSpline
from .tables import limited

__all__ = ["UNLIMITED", "Circle", "CubicSpline", "Ellipse", "Frame", "Line", "Path", "limited"]
