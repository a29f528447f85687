"""Conversion of a signal to another unit."""

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
    UnitError,
    Units,
    convert_unit,
    parameter,
    parse_unit,
    shorten,
)


class UnitConversion(Block):
    """Conversion to another unit of the same dimension: y = k u + c, such as °C to K.

    Raises
    ------
    ParameterError
        For units of different dimensions, and for those that can't be read.
    UnitError
        For a difference of temperatures where the conversion adds an offset, when the diagram is built.

    Examples
    --------
    >>> from loopwright import Diagram
    >>> from loopwright.blocks import Constant, UnitConversion
    >>> warm = UnitConversion(from_unit="degC", to_unit="K")(Constant(value=20.0, unit="degC"))
    >>> Diagram("d", warm.named("T")).simulate(0.1, step=0.1, progress=False)["T"]
    array([293.15, 293.15])
    """

    from_unit: PortUnit = parameter(description="unit of the input, or one for each entry")
    to_unit: PortUnit = parameter(description="unit of the output, or one for each entry")

    def check(self) -> None:
        """Refuse units of different dimensions."""
        try:
            factor, _ = self.law
        except (UnitError, TypeError, AttributeError) as error:
            raise ParameterError(
                f"found {self.from_unit!r} and {self.to_unit!r}; expected two units of one dimension. {error} Give "
                "another unit.",
                port="to_unit",
            ) from None
        except (ValueError, IndexError):
            factor = np.zeros(0)
        if not factor.size:
            raise ParameterError(
                f"found {self.from_unit!r} and {self.to_unit!r}; expected as many units in both. Give these.",
                port="to_unit",
            )

    @property
    def law(self) -> tuple[np.ndarray, np.ndarray]:
        """The factor k and the offset c, numbers or one for each entry."""
        ends: list[Any] = [self.from_unit, self.to_unit]
        count = next((len(unit) for unit in ends if isinstance(unit, tuple)), None)
        if count is None:
            k, c = convert_unit(*ends)
            return np.asarray(k), np.asarray(c)
        entries = [unit if isinstance(unit, tuple) else (unit,) * count for unit in ends]
        found = np.array([convert_unit(a, b) for a, b in zip(*entries, strict=True)])
        return found[:, 0], found[:, 1]

    @property
    def inputs(self) -> Mapping[str, Input]:  # type: ignore[override]
        """The signal, of any shape."""
        return {"u": Input(shape=None, unit=self.from_unit, description="signal to convert, of any shape", name="u")}

    @property
    def outputs(self) -> Mapping[str, Output]:  # type: ignore[override]
        """The signal in the other unit."""
        return {"y": Output(shape=None, unit=self.to_unit, description="the signal in the other unit", name="y")}

    def output_units(self, units: Units) -> Mapping[str, PortUnit]:
        """Refuse a difference of temperatures where the conversion adds an offset: 5 °C of difference are 5 K."""
        unit, offset = units["u"], np.any(self.law[1])
        entries = unit if isinstance(unit, tuple) else () if unit is None else (unit,)
        if offset and any(parse_unit(entry).relative for entry in entries):
            raise UnitError(
                f"expected a temperature, as the conversion to {self.to_unit} adds {shorten(self.law[1])}, and found a "
                "difference of two: wire it without the conversion",
                port="u",
            )
        return {}

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the signal in the other unit."""
        k, c = self.law
        return k * u.u + c if np.any(c) else k * u.u
