"""Common parts of blocks that branch: truth, numbered inputs, checks of shapes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core import (
    Array,
    Block,
    Input,
    PortUnit,
    ShapeError,
    check_shapes,
    common_unit,
    number_inputs,
    parameter,
    shape_of,
)


def check_fits(value: Array, port: str, main: Array, main_port: str) -> None:
    """Refuse a signal that is neither a scalar nor of the main signal's shape, which a state has as well."""
    if shape_of(value) not in ((), shape_of(main)):
        raise ShapeError(
            f"found shape {shape_of(value)}; expected a scalar, or {shape_of(main)} as {main_port} has. Take a part of "
            f"it, such as signal[0], or wire a vector to {main_port}.",
            port=port,
        )


def truth(u: Array) -> Array:
    """Return 1 where a logic signal is true (above 0.5), 0 where it is not; NaN passes through."""
    return np.where(u > 0.5, 1.0, np.where(u <= 0.5, 0.0, u))


def expect_scalar(value: Array, port: str) -> Array:
    """Return the signal of an event, and refuse a vector: an event is one crossing of one number."""
    if shape_of(value):
        raise ShapeError(
            f"found shape {shape_of(value)}; expected a scalar in a continuous subsystem, where it switches by events. "
            "Index the signal, as in u[0], and give each entry its own block, or put the block into a "
            "@subsystem(sample_time=…), where it acts on every entry.",
            port=port,
        )
    return value


def unit_of_one(*units: PortUnit) -> PortUnit:
    """Return the unit of a signal that is one of several in like units, None for those without one."""
    known = [unit for unit in units if unit is not None]
    count = next((len(unit) for unit in known if isinstance(unit, tuple)), None)
    if len(known) < 2:
        return known[0] if known else None
    if count is None:
        return common_unit(*(unit for unit in known if isinstance(unit, str)))
    entries = [unit if isinstance(unit, tuple) else (unit,) * count for unit in known]
    return tuple(common_unit(*each) for each in zip(*entries, strict=False))


class NumberedInputs(Block):
    """Base of the blocks with ``count`` inputs ``u1``, ``u2``, …, of one shape (a scalar goes with any)."""

    count: int = parameter(default=2, minimum=1, description="number of inputs")

    @property
    def inputs(self) -> Mapping[str, Input]:  # type: ignore[override]
        """The numbered inputs."""
        return number_inputs(self.count)

    def fold(self, u: Any, combine: Any) -> Array:
        """Combine the inputs from the first to the last."""
        check_shapes(**u._asdict())
        total = u[0]
        for value in u[1:]:
            total = combine(total, value)
        return total
