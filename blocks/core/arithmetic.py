"""Blocks of arithmetic, which operators on signals make: sum, gain and product, and the stack of a list of signals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from . import arguments as kinds
from .arguments import shorten
from .block import Block
from .errors import ParameterError, ShapeError
from .numpy_functions import Units, follow_entries, multiply_units
from .ports import Input, Output, PortUnit, Shape, number_inputs
from .units import common_unit, is_uncertain, same_unit, sum_unit
from .values import Array, parameter


def shape_of(value: Array) -> Shape:
    """Return the shape of numbers or of a traced value."""
    return tuple(getattr(value, "shape", ()))


def describe_shape(shape: tuple[int, ...] | None) -> str:
    """Return a shape in words, for messages, such as ``a scalar`` or ``(2,)``; None is any one."""
    if shape is None:
        return "any shape"
    return str(shape) if shape else "a scalar"


def check_shapes(**values: Array) -> None:
    """Refuse values of different shapes; a scalar goes with any."""
    first = next(((name, shape_of(v)) for name, v in values.items() if shape_of(v)), ("", ()))
    for name, value in values.items():
        if shape_of(value) not in ((), first[1]):
            raise ShapeError(
                f"found shape {shape_of(value)} next to {first[0]} of shape {first[1]}; expected one shape for both, "
                "or a scalar. Take a part of the longer one, such as signal[0:2], or wire another.",
                port=name,
            )


def clip(value: Array, lower: Array | None, upper: Array | None) -> Array:
    """Return a value within limits, None for none, in an equation; NaN passes through (a traced np.clip loses it)."""
    value = value if upper is None else np.where(value > upper, upper, value)
    return value if lower is None else np.where(value < lower, lower, value)


class Sum(Block):
    """Sum with signs: y = ± u₁ ± u₂ ….

    Inputs ``u1``, ``u2``, …, one for each sign, have one shape and unit (a scalar goes with any shape). The output
    ``y`` has the same, but for temperatures in °C: one less another is a difference, in K, and one with a difference is
    a temperature. What has no unit counts as a difference where it is added. Of other sums, such as that of two
    temperatures, the unit is not known.

    Raises
    ------
    ParameterError
        For signs other than plus and minus.
    ShapeError
        For inputs of different shapes, when the diagram is built.
    """

    same_units = True
    signs: str = parameter(
        default="++",
        description="one + or - for each input",
        kind=kinds.text.where(lambda signs: bool(signs) and not set(signs) - {"+", "-"}).worded(
            "a + or - for each input, such as '+-'", "Give one for each."
        ),
    )
    y = Output(shape=None, description="the sum")

    @property
    def inputs(self) -> Mapping[str, Input]:  # type: ignore[override]
        """One input per sign."""
        return number_inputs(len(self.signs))

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the sum."""
        check_shapes(**u._asdict())
        total = u[0] if self.signs[0] == "+" else -u[0]
        for sign, value in zip(self.signs[1:], u[1:], strict=True):
            total = total + value if sign == "+" else total - value
        return total

    def output_units(self, units: Units) -> Mapping[str, PortUnit]:
        """Return the unit of the sum."""
        signs = [1 if sign == "+" else -1 for sign in self.signs]
        count = next((len(unit) for unit in units.values() if isinstance(unit, tuple)), None)
        if count is None:
            plain = [unit if isinstance(unit, str) else None for unit in units.values()]
            return {"y": sum_unit(*zip(plain, signs, strict=True))}
        entries = [unit if isinstance(unit, tuple) else (unit,) * count for unit in units.values()]
        if any(len(entry) != count for entry in entries):
            return {}
        found = [sum_unit(*zip(entry, signs, strict=True)) for entry in zip(*entries, strict=True)]
        known = tuple(unit for unit in found if unit is not None)
        return {"y": known} if len(known) == count else {}


class Gain(Block):
    """Gain: y = k u, element by element, or the matrix product y = K u for a matrix K.

    The output's unit is not declared: a gain may convert one.

    Raises
    ------
    ParameterError
        For a gain of more than two dimensions.
    ShapeError
        For an input with another number of entries than the vector or the matrix takes, when the diagram is built.
    """

    gain: Array = parameter(
        description="number, array of the signal's shape, or matrix",
        kind=kinds.dimensions(2).worded("a number, a vector or a matrix"),
    )
    u = Input(shape=None, description="signal to multiply, of any shape")
    y = Output(shape=None, description="the product")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the product."""
        gain, found = shape_of(self.gain), shape_of(u.u)
        if len(gain) < 2:
            check_shapes(gain=self.gain, u=u.u)
        elif found[:1] != gain[1:]:
            raise ShapeError(
                f"found {f'shape {found}' if found else 'a scalar'}; the gain is a matrix of {gain[0]} × {gain[1]} and "
                f"takes {gain[1]} entries. Wire a signal of as many, or give another matrix.",
                port="u",
            )
        return self.gain @ u.u if getattr(self.gain, "ndim", 0) == 2 else self.gain * u.u


class Product(Block):
    """Product, element by element: y = u₁ u₂.

    Raises
    ------
    ShapeError
        For inputs of different shapes (a scalar goes with any), when the diagram is built.
    """

    u1 = Input(shape=None, description="first factor, of any shape")
    u2 = Input(shape=None, description="second factor, of the same shape or a scalar")
    y = Output(shape=None, description="the product")

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the product."""
        check_shapes(**u._asdict())
        return u.u1 * u.u2

    def output_units(self, units: Units) -> Mapping[str, PortUnit]:
        """Return the product of the factors' units."""
        known = {name: unit for name, unit in units.items() if unit is not None}
        return {"y": follow_entries(multiply_units, known, "multiply")} if len(known) == 2 else {}


class Stack(Block):
    """Vector of the entries of its inputs, in a row; other tools call it a mux.

    A tuple or a list of signals in a call makes one: ``observer((u, y))`` is ``observer(Stack()(u, y))``.
    `Demux` is its reverse. The output has the unit that its inputs have in common, or one for each entry.

    Inputs ``u1``, ``u2``, … are scalars or vectors. The output ``y`` has as many entries as all of them together. With
    ``rows=True``, as ``np.stack`` makes it, vectors are the rows of a matrix, and scalars the entries of a vector.

    Raises
    ------
    ShapeError
        For a matrix as input, and for rows of different shapes, when the diagram is built.
    """

    units_by_entry = True
    count: int = parameter(default=2, minimum=1, description="number of inputs")
    rows: bool = parameter(default=False, description="True for one row of a matrix by each vector")
    y = Output(shape=None, description="the entries of all inputs")

    @property
    def inputs(self) -> Mapping[str, Input]:  # type: ignore[override]
        """The numbered inputs."""
        return number_inputs(self.count)

    def output(self, t: Array, x: Any, u: Any) -> Array:
        """Return the vector."""
        for name, value in u._asdict().items():
            if len(shape_of(value)) > 1:
                raise ShapeError(
                    f"found shape {shape_of(value)}; expected a scalar or a vector. Wire a part of it.", port=name
                )
            if self.rows and shape_of(value) != shape_of(u[0]):
                raise ShapeError(
                    f"found shape {shape_of(value)} next to {shape_of(u[0])}; expected rows of one shape. Write "
                    "np.concatenate, or a list of the signals, for their entries in a row.",
                    port=name,
                )
        if self.rows and shape_of(u[0]):
            return np.stack(u)
        return np.concatenate([value if shape_of(value) else np.stack([value]) for value in u])

    def output_units(self, units: Units) -> Mapping[str, PortUnit]:
        """Return the unit that all entries have, else one for each."""
        if any(unit is None for unit in units.values()):
            return {}
        entries = [
            e for unit in units.values() if unit is not None for e in ((unit,) if isinstance(unit, str) else unit)
        ]
        alike = all(same_unit(entry, entries[0]) for entry in entries)
        common = common_unit(*entries) if alike else None  # uncertain, if some are differences
        if common is not None and (not is_uncertain(common) or any(map(is_uncertain, entries))):
            return {"y": common}
        sized = all(isinstance(unit, tuple) for unit in units.values())
        return {"y": tuple(entries) if sized and not (self.rows and len(entries) > self.count) else common}


Mux = Stack
"""The name by which users of other tools look for `Stack`."""


class Demux(Block):
    """Parts of a vector, as signals: y₁ has its first entries, y₂ the next ones, and so on.

    ``a, b = Demux(2)(vector)`` are two scalars, ``position, speed = Demux((3, 1))(vector)`` a vector of three entries
    and a scalar. A part of a signal needs no block: ``vector[0]``, ``vector[1:3]``. `Stack` is its reverse.

    Raises
    ------
    ParameterError
        For sizes that are not whole numbers of one or more.
    ShapeError
        For a signal that is no vector of as many entries, when the diagram is built.
    """

    sizes: object = parameter(
        kw_only=False, description="number of scalars, or the number of entries of each output; 1 makes a scalar"
    )
    u = Input(shape=None, description="vector")

    def check(self) -> None:
        """Refuse sizes that are no whole numbers."""
        sizes = self.sizes if isinstance(self.sizes, tuple) else (self.sizes,)
        if not sizes or not all(isinstance(n, int | np.integer) and not isinstance(n, bool) and n >= 1 for n in sizes):
            raise ParameterError(
                f"found {shorten(self.sizes)}; expected the number of scalars, such as 3, or the entries of each "
                "output, such as (2, 1). Give whole numbers of one or more.",
                port="sizes",
            )

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of entries of each output."""
        sizes: Any = self.sizes
        return tuple(map(int, sizes)) if isinstance(sizes, tuple) else (1,) * int(sizes)

    @property
    def outputs(self) -> Mapping[str, Output]:  # type: ignore[override]
        """One output for each part: ``y1``, ``y2``, …."""
        shapes = [() if n == 1 else (n,) for n in self.counts]
        return {f"y{i}": Output(shape, name=f"y{i}", description="a part") for i, shape in enumerate(shapes, 1)}

    def _parts(self) -> list[int | slice]:
        ends = np.cumsum(self.counts).tolist()
        return [end - 1 if n == 1 else slice(end - n, end) for n, end in zip(self.counts, ends, strict=True)]

    def output(self, t: Array, x: Any, u: Any) -> tuple[Array, ...] | Array:
        """Return the parts."""
        if shape_of(u.u) != (sum(self.counts),):
            raise ShapeError(
                f"found shape {shape_of(u.u)}; expected a vector of {sum(self.counts)} entries, one for each of sizes="
                f"{self.sizes}. Wire another signal, or give other sizes.",
                port="u",
            )
        parts = tuple(u.u[part] for part in self._parts())
        return parts if len(parts) > 1 else parts[0]

    def output_units(self, units: Units) -> Mapping[str, PortUnit]:
        """Return the units of the parts."""
        unit = units["u"]
        if not isinstance(unit, tuple):
            return dict.fromkeys(self.outputs, unit)
        if len(unit) != sum(self.counts):
            return {}
        return {name: unit[part] for name, part in zip(self.outputs, self._parts(), strict=True)}
