"""Lookup tables of one and two inputs, as blocks."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ..core import Array, Block, GuardError, Input, Output, ParameterError, ShapeError, clip, kinds, parameter, shape_of
from .piecewise_functions import bilinear, piecewise

_BEYOND = kinds.choice("hold", "extrapolate", "error")
_BREAKPOINTS = kinds.rising.worded(step="Sort them, with their values, and leave out repeated ones.")
_SLACK = 1e-9  # part of the table's range by which rounding may put an input outside


def _keep_within(points: np.ndarray, u: Array) -> Array:
    """Return u within the ends of the table."""
    return clip(u, float(points[0]), float(points[-1]))


class _End(NamedTuple):
    """End of a table, by which an entry of an input can leave it."""

    entry: str
    position: int
    side: str

    @property
    def guard(self) -> str:
        """Name of the guard."""
        return f"{self.entry} {self.side}"


def _ends(port: str, shape: tuple[int, ...]) -> list[_End]:
    """Return the two ends of the table for every entry of an input."""
    entries = [f"{port}[{i + 1}]" for i in range(shape[0])] if shape else [port]
    return [_End(entry, i, side) for i, entry in enumerate(entries) for side in ("below", "above")]


def _margins(points: np.ndarray, name: str, u: Array) -> dict[str, Array]:
    """Return the distances of every entry of u from the table's ends, positive within."""
    slack = _SLACK * float(points[-1] - points[0])
    low, high = float(points[0]) - slack, float(points[-1]) + slack
    shape, margins = shape_of(u), {}
    for end in _ends(name, shape):
        value = u[end.position] if shape else u
        margins[end.guard] = value - low if end.side == "below" else high - value
    return margins


def _range_error(name: str, points: dict[str, np.ndarray], u: Any) -> GuardError:
    """Return the error of an input beyond the table."""
    ends = ((port, end) for port in points for end in _ends(port, np.shape(getattr(u, port))))
    port, (entry, position, side) = next((port, end) for port, end in ends if end.guard == name)
    value, table = np.ravel(getattr(u, port))[position], points[port]
    return GuardError(
        f"found {entry} = {value:.9g}, {side} the table's range; expected {table[0]:g} to {table[-1]:g}. Extend the "
        "table, or give beyond='hold' or beyond='extrapolate'.",
        port=port,
    )


class Lookup1D(Block):
    """Table of one input: y = f(u), f through the points (breakpoints[i], values[i]).

    ``interpolation`` is "linear", "cubic" (a spline, twice continuously differentiable, not-a-knot at its ends) or
    "monotone" (a cubic that rises and falls only where the points do, once differentiable). Beyond the ends ``beyond``
    holds the last value ("hold"), continues the end piece ("extrapolate"), or stops the run ("error").

    The values may be vectors, one row for each breakpoint; a vector u is looked up element by element. NaN passes
    through. Derivatives of a trace are exact, and a kink needs no event. Where the table reads a `Clock`, also one with
    gains and constants, a solver lands on the breakpoints. `PiecewiseLinear` and `Recorded` are tables over time.

    Raises
    ------
    ParameterError
        For breakpoints that don't rise, another number of values, and an unknown choice.
    ShapeError
        For a vector u with vectors as values, and a u of two dimensions, when the diagram is built.
    GuardError
        In a run, where u leaves the table, with beyond="error".
    """

    _hint = "lookup_1d"
    breakpoints: Array = parameter(structural=True, description="values of u, rising", kind=_BREAKPOINTS)
    values: Array = parameter(structural=True, description="values of y there; with several columns y is a vector")
    interpolation: str = parameter(
        default="linear",
        description="'linear', 'cubic' or 'monotone'",
        kind=kinds.choice("linear", "cubic", "monotone"),
    )
    beyond: str = parameter(
        default="hold", description="beyond the ends: 'hold', 'extrapolate' or 'error'", kind=_BEYOND
    )
    u = Input(shape=None, description="the argument: a scalar, or a vector of them")
    y = Output(shape=None, description="value of the table")

    def check(self) -> None:
        """Refuse values of another shape."""
        n, shape = np.size(self.breakpoints), np.shape(self.values)
        if len(shape) not in (1, 2) or shape[0] != n:
            raise ParameterError(
                f"found shape {shape} for {n} breakpoints; expected ({n},), or ({n}, columns). Give one value, or one "
                "row, for each breakpoint.",
                port="values",
            )

    @cached_property
    def _coefficients(self) -> np.ndarray:
        """Coefficients (pieces, columns, powers), the lowest power first."""
        points = np.asarray(self.breakpoints)
        values = np.asarray(self.values).reshape(len(points), -1)
        if self.interpolation == "linear":
            slopes = np.diff(values, axis=0) / np.diff(points)[:, None]
            return np.stack([values[:-1], slopes], axis=2)
        from scipy.interpolate import CubicSpline, PchipInterpolator  # imported late, since it takes long

        made = (CubicSpline if self.interpolation == "cubic" else PchipInterpolator)(points, values).c
        return np.ascontiguousarray(made[::-1].transpose(1, 2, 0))

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the value of the table."""
        shape, columns = shape_of(u.u), np.ndim(self.values) == 2
        if len(shape) > (0 if columns else 1):
            expected = "a scalar, since the values are vectors" if columns else "a scalar or a vector"
            raise ShapeError(f"found shape {shape}; expected {expected}. Look up one part at a time, u[0].", port="u")
        inside = u.u if self.beyond == "extrapolate" else _keep_within(self.breakpoints, u.u)
        entries = [inside[i] for i in range(shape[0])] if shape else [inside]
        found = [piecewise(self.breakpoints, self._coefficients, entry) for entry in entries]
        if columns:
            return found[0]
        return np.stack([value[0] for value in found]) if shape else found[0][0]

    def input_breaks(self) -> Mapping[str, Array]:
        """Return the breakpoints: a solver lands on them where the table reads the time."""
        return {"u": self.breakpoints}

    def guards(self, t: Array, x: Any, u: Any) -> dict[str, Array]:
        """Return the distances from the ends, if leaving the table is an error."""
        return _margins(self.breakpoints, "u", u.u) if self.beyond == "error" else {}

    def guard_error(self, name: str, value: float, u: Any, y: Any, x: Any = None) -> GuardError:
        """Return the error that names the input and the table's range."""
        return _range_error(name, {"u": self.breakpoints}, u)


class Lookup2D(Block):
    """Table of two inputs, bilinear: y = f(u₁, u₂), f through the points (rows[i], columns[j], values[i, j]).

    Beyond the edges ``beyond`` holds the nearest value of the edge ("hold"), continues the outermost cell
    ("extrapolate"), or stops the run ("error"). NaN passes through. Derivatives of a trace are exact.

    Raises
    ------
    ParameterError
        For breakpoints that don't rise, values of another shape, and an unknown choice.
    GuardError
        In a run, where an input leaves the table, with beyond="error".
    """

    _hint = "lookup_2d"
    rows: Array = parameter(structural=True, description="values of u₁, rising", kind=_BREAKPOINTS)
    columns: Array = parameter(structural=True, description="values of u₂, rising", kind=_BREAKPOINTS)
    values: Array = parameter(structural=True, description="values of y: one row for each u₁, one column for each u₂")
    beyond: str = parameter(
        default="hold", description="beyond the edges: 'hold', 'extrapolate' or 'error'", kind=_BEYOND
    )
    u1 = Input(description="argument along the rows' breakpoints")
    u2 = Input(description="argument along the columns' breakpoints")
    y = Output(description="value of the table")

    def check(self) -> None:
        """Refuse values of another shape."""
        expected = (np.size(self.rows), np.size(self.columns))
        if np.shape(self.values) != expected:
            raise ParameterError(
                f"found shape {np.shape(self.values)}; expected {expected}, a row for each of rows and a column for "
                "each of columns. Give the transpose, or other breakpoints.",
                port="values",
            )

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the value of the table."""
        a, b = u.u1, u.u2
        if self.beyond != "extrapolate":
            a, b = _keep_within(self.rows, a), _keep_within(self.columns, b)
        return bilinear(self.rows, self.columns, self.values, a, b)

    def input_breaks(self) -> Mapping[str, Array]:
        """Return the breakpoints: a solver lands on them where the table reads the time."""
        return {"u1": self.rows, "u2": self.columns}

    def guards(self, t: Array, x: Any, u: Any) -> dict[str, Array]:
        """Return the distances from the edges, if leaving the table is an error."""
        if self.beyond != "error":
            return {}
        return _margins(self.rows, "u1", u.u1) | _margins(self.columns, "u2", u.u2)

    def guard_error(self, name: str, value: float, u: Any, y: Any, x: Any = None) -> GuardError:
        """Return the error that names the input and the table's range."""
        return _range_error(name, {"u1": self.rows, "u2": self.columns}, u)
