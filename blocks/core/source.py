"""Base of all sources, and the constant that a number on a wire becomes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .block import Block
from .errors import UnitError
from .instants import move_earlier
from .ports import Output, PortUnit
from .units import parse_unit, rate_of
from .values import Array, parameter


class Source(Block):
    """Base of the sources: one output, ``y``, in the unit that the parameter ``unit`` declares.

    If y is a value with its first two time derivatives, ``unit`` is that of the value.
    """

    unit: str | None = parameter(default=None, description="unit of the output; None: not checked")
    y = Output(shape=None)

    def check(self) -> None:
        """Refuse a unit that can't be read."""
        try:
            parse_unit(self.unit or "1")
        except UnitError as error:
            error.at(port="unit")
            raise

    @property
    def outputs(self) -> dict[str, Output]:  # type: ignore[override]
        """The output in the declared unit."""
        declared, unit = type(self).y, self.unit
        each: PortUnit = unit
        if unit is not None and declared.shape == (3,):
            each = (unit, rate_of(unit), rate_of(rate_of(unit)))
        return {"y": Output(declared.shape, each, declared.description, name="y")}

    def instants(self) -> Array:
        """Return the times, in any order, at which the output or its derivatives are not smooth: none by default."""
        return np.zeros(0)

    def next_instant(self, t: float) -> float:
        """Return the first of `instants` after t; one that differs from t by rounding is not after it."""
        times = np.ravel(self.instants())
        return float(np.min(times[move_earlier(times) > t], initial=math.inf))

    def changes(self) -> tuple[Array, Array]:
        """Return the times at which the output, or its first entry, begins to change its level, and by how much.

        They are none by default.
        """
        return np.zeros(0), np.zeros(0)

    def own_step(self, t: float) -> float:
        """Return the first change of level after t, or else the last one before; 0 without any."""
        times, heights = (np.ravel(np.asarray(values, dtype=float)) for values in self.changes())
        times, heights = times[heights != 0.0], heights[heights != 0.0]
        after = np.flatnonzero(move_earlier(times) > t)
        return float(heights[after[0] if after.size else -1]) if heights.size else 0.0


class Constant(Source):
    """Constant number or array."""

    value: Array = parameter(description="number or array")

    @property
    def outputs(self) -> dict[str, Output]:  # type: ignore[override]
        """The output in the declared unit, of the value's shape."""
        return {"y": Output(shape=np.shape(self.value), unit=self.unit, name="y")}

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the constant."""
        return self.value
