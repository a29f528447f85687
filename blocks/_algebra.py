"""Algebraic blocks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ._block import Block
from ._errors import ParameterError
from ._ports import Input, Output
from ._values import Array, parameter


class Sum(Block):
    """Sum with signs: y = ± u1 ± u2 ….

    Ports: inputs ``u1``, ``u2``, …, all of one shape and unit; output ``y``.
    """

    same_units = True
    signs: str = parameter(default="++", description="one + or - for each input")
    y = Output(like="u1")

    def check(self) -> None:
        """Refuse anything but plus and minus signs."""
        if not self.signs or set(self.signs) - {"+", "-"}:
            raise ParameterError(
                f"found {self.signs!r}; expected a + or - for each input, such as '+-'.", block=self.label, port="signs"
            )

    @property
    def inputs(self) -> Mapping[str, Input]:  # type: ignore[override]
        """One input per sign."""
        return {f"u{i}": Input(shape=None, name=f"u{i}") for i in range(1, len(self.signs) + 1)}

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the sum."""
        total = u[0] if self.signs[0] == "+" else -u[0]
        for sign, value in zip(self.signs[1:], u[1:], strict=True):
            total = total + value if sign == "+" else total - value
        return total


class Gain(Block):
    """Gain: y = k u, element by element, or the matrix product K u for a matrix.

    The output's unit is not declared: a gain may convert one.
    """

    gain: Array = parameter(description="number, array of the signal's shape, or matrix")
    u = Input(shape=None)
    y = Output(shape=None)

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the product."""
        return self.gain @ u.u if getattr(self.gain, "ndim", 0) == 2 else self.gain * u.u


class Product(Block):
    """Product, element by element: y = u1 u2."""

    u1 = Input(shape=None)
    u2 = Input(shape=None)
    y = Output(shape=None)

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the product."""
        return u.u1 * u.u2


class Saturation(Block):
    """Saturation: y = u limited to ±limit, element by element; NaN passes through.

    The secondary output ``excess`` is what was cut off, u − y: zero exactly while no limit acts. It drives the
    anti-windup of `ErrorDynamics`.
    """

    limit: Array = parameter(above=0.0, description="largest magnitude, a number or one for each element")
    u = Input(shape=None)
    y = Output(like="u")
    excess = Output(like="u", secondary=True)

    def output(self, t: Array, x: Any, u: Any) -> tuple[Array, Array]:
        """Return the limited signal and what was cut off."""
        low = np.where(u.u < -self.limit, -self.limit, u.u)
        y = np.where(u.u > self.limit, self.limit, low)
        return y, u.u - y
