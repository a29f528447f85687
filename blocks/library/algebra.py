"""Algebraic blocks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core import (
    Array,
    Block,
    Input,
    Output,
    ParameterError,
    PortUnit,
    Units,
    check_shapes,
    clip,
    difference_unit,
    parameter,
    raise_unit,
    shorten,
)
from .branching import NumberedInputs, unit_of_one


class Minimum(NumberedInputs):
    """Smallest of its inputs, element by element: y = min(u₁, u₂, …); NaN in any of them passes through.

    Raises
    ------
    ShapeError
        For inputs of different shapes (a scalar goes with any), when the diagram is built.
    """

    same_units = True
    y = Output(shape=None, description="the smallest")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the smallest."""
        return self.fold(u, lambda a, b: np.where(a < b, a, np.where(b <= a, b, a + b)))

    def output_units(self, units: Units) -> Mapping[str, PortUnit]:
        """Return the unit that the inputs have."""
        return {"y": unit_of_one(*units.values())}


class Maximum(NumberedInputs):
    """Largest of its inputs, element by element: y = max(u₁, u₂, …); NaN in any of them passes through.

    Raises
    ------
    ShapeError
        For inputs of different shapes (a scalar goes with any), when the diagram is built.
    """

    same_units = True
    y = Output(shape=None, description="the largest")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the largest."""
        return self.fold(u, lambda a, b: np.where(a > b, a, np.where(b >= a, b, a + b)))

    def output_units(self, units: Units) -> Mapping[str, PortUnit]:
        """Return the unit that the inputs have."""
        return {"y": unit_of_one(*units.values())}


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


class Power(Block):
    """Power with a constant exponent, element by element: y = uⁿ; ``u**2`` makes one.

    A number that is not whole takes no negative u: the result is NaN, which stops the run. The unit of y is the power
    of the input's where FMI can write it: m2 of m, but none of m with the exponent 0.3.
    """

    exponent: float = parameter(structural=True, description="exponent n")
    u = Input(shape=None, description="base, of any shape")
    y = Output(shape=None, description="the power")

    @property
    def drawn_inside(self) -> str:
        """What a drawing shows."""
        number = f"{self.exponent:g}"
        return f"u^{number}" if set(number) - set("-0123456789") else f"u{number.translate(_RAISED)}"

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the power."""
        return u.u**self.exponent

    def output_units(self, units: Units) -> Mapping[str, PortUnit]:
        """Return the power of the input's unit."""
        unit = units["u"]
        if isinstance(unit, tuple):
            powers = [raise_unit(entry, self.exponent) for entry in unit]
            return {} if None in powers else {"y": tuple(power for power in powers if power is not None)}
        return {} if unit is None else {"y": raise_unit(unit, self.exponent)}


class Limited(Block):
    """Base of the blocks with limits: ±limit, or a lower limit, an upper limit or both."""

    limit: Array | None = parameter(
        default=None, above=0.0, description="largest magnitude, a number or one for each element"
    )
    lower: Array | None = parameter(default=None, description="lower limit, in place of limit; None for none")
    upper: Array | None = parameter(default=None, description="upper limit, in place of limit; None for none")
    u = Input(shape=None, description="signal to limit, of any shape")

    def check(self) -> None:
        """Refuse no limits, two kinds of limits, and limits that cross."""
        sides = {k: v for k, v in (("lower", self.lower), ("upper", self.upper)) if v is not None}
        if (self.limit is None) == (not sides):
            found = "no limit" if not sides else f"limit and {' and '.join(sides)}"
            raise ParameterError(
                f"found {found}; expected limit=… for ±limit, or lower=… or upper=… or both. Give these.", port="limit"
            )
        if len(sides) == 2:
            check_shapes(**sides)
            if np.any(np.asarray(self.lower) >= np.asarray(self.upper)):
                raise ParameterError(
                    f"found lower={shorten(self.lower)} and upper={shorten(self.upper)}; expected lower below upper. "
                    "Exchange them, or move one.",
                    port="lower",
                )

    def limited(self, u: Array) -> Array:
        """Return u within the limits."""
        given = {k: v for k in ("limit", "lower", "upper") if (v := getattr(self, k)) is not None}
        check_shapes(**given, u=u)
        return clip(u, self.lower, self.upper) if self.limit is None else clip(u, -self.limit, self.limit)

    def part_units(self, port: str, units: Units) -> Mapping[str, PortUnit]:
        """Return the unit of an output that is the part of the signal beyond the limits: K for °C."""
        unit = units["u"]
        return {port: tuple(map(difference_unit, unit)) if isinstance(unit, tuple) else unit and difference_unit(unit)}


class Saturation(Limited):
    """Saturation: y = u limited to ±limit, or to [lower, upper], element by element; NaN passes through.

    The secondary output ``excess`` is the part cut off, u − y: zero exactly while no limit acts. It drives the
    anti-windup of `ErrorDynamics`. The kinks need no events.

    Raises
    ------
    ParameterError
        For no limit, for ``limit`` next to ``lower`` or ``upper``, and for limits that cross.
    ShapeError
        For limits and a signal of different shapes, when the diagram is built.
    """

    y = Output(like="u", description="the limited signal")
    excess = Output(shape=None, secondary=True, description="the part cut off, u − y")

    def output(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the limited signal and the part cut off."""
        y = self.limited(u.u)
        return y, u.u - y

    def output_units(self, units: Units) -> Mapping[str, PortUnit]:
        """Return the unit of the part cut off."""
        return self.part_units("excess", units)


class DeadZone(Limited):
    """Dead zone: y = u − (u limited to ±limit, or to [lower, upper]), element by element; NaN passes through.

    y is zero exactly within the limits, and rises from zero outside of them with slope 1. The kinks need no events.

    Raises
    ------
    ParameterError
        For no limit, for ``limit`` next to ``lower`` or ``upper``, and for limits that cross.
    ShapeError
        For limits and a signal of different shapes, when the diagram is built.
    """

    y = Output(shape=None, description="the part beyond the limits")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the part beyond the limits."""
        return u.u - self.limited(u.u)

    def output_units(self, units: Units) -> Mapping[str, PortUnit]:
        """Return the unit of the part beyond the limits."""
        return self.part_units("y", units)
