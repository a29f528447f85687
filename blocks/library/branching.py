"""What blocks that branch have in common: truth, numbered inputs, and events that take one signal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core.arithmetic import check_shapes, shape_of
from ..core.block import Block
from ..core.errors import ShapeError
from ..core.ports import Input
from ..core.values import Array, parameter


def check_fits(value: Array, port: str, main: Array, main_port: str) -> None:
    """Refuse a signal that is neither a scalar nor of the shape of the main one, which a state has as well.

    Raises
    ------
    ShapeError
        Any other shape.
    """
    if shape_of(value) not in ((), shape_of(main)):
        raise ShapeError(
            f"found shape {shape_of(value)}; expected a scalar, or {shape_of(main)} as {main_port} has. Take a part of "
            f"it, such as signal[0], or wire a vector to {main_port}.",
            port=port,
        )


def truth(u: Array) -> Array:
    """Return 1 where a logic signal is true (above 0.5), 0 where it is not; NaN passes through."""
    return np.where(u > 0.5, 1.0, np.where(u <= 0.5, 0.0, u))


def single(value: Array, port: str) -> Array:
    """Return the signal that an event looks at, and refuse a vector: an event is one crossing of one number.

    Raises
    ------
    ShapeError
        A signal of several entries.
    """
    if shape_of(value):
        raise ShapeError(
            f"found shape {shape_of(value)}; in a continuous frame it switches by events and takes a scalar. Index the "
            "signal, as in u[0], and give each entry a block of its own, or put the block into a "
            "@subsystem(sample_time=…), where it acts on every entry.",
            port=port,
        )
    return value


class Numbered(Block):
    """Base of the blocks with inputs ``u1``, ``u2``, …: ``count`` of them, of one shape (a scalar goes with any)."""

    count: int = parameter(default=2, minimum=1, description="how many inputs there are")

    @property
    def inputs(self) -> Mapping[str, Input]:  # type: ignore[override]
        """The numbered inputs."""
        return {f"u{i}": Input(shape=None, name=f"u{i}") for i in range(1, self.count + 1)}

    def folded(self, u: Any, combine: Any) -> Array:
        """Return ``combine`` applied from the first input to the last."""
        check_shapes(**u._asdict())
        total = u[0]
        for value in u[1:]:
            total = combine(total, value)
        return total
