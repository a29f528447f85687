"""Planar paths: ellipse, circle, line, cubic spline, and the base for paths of one's own."""

from __future__ import annotations

from ._paths_base import UNLIMITED, Frame, Path
from ._paths_shapes import Circle, Ellipse, Line
from ._paths_spline import CubicSpline
from ._paths_tables import limited

__all__ = ["UNLIMITED", "Circle", "CubicSpline", "Ellipse", "Frame", "Line", "Path", "limited"]
