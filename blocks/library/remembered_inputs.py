"""Bases of blocks that remember their input: as it is just before t = 0, and its last n values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..core import Array, Block, Input, Shape, ShapeError, State


class StartsAtInput:
    """A block that remembers its input ``u``: without an ``initial_value``, as it is just before t = 0."""

    initial_value: Array | None

    @property
    def starts_from_inputs(self) -> bool:
        """Whether `initial` computes the state."""
        return self.initial_value is None

    def initial(self, u: Any) -> Array:
        """Return the state at the start."""
        return u.u


class History(State):
    """State of the last inputs of a `PastInputs`, the oldest first, one in a row."""

    def start_value(self, block: Any, shapes: Mapping[str, Shape]) -> np.ndarray:
        """Return the start value, equal in all rows."""
        shape = shapes.get(self.like or "")
        if shape is None:  # the input's shape is not known yet: one row, which may show it
            return super().start_value(block, shapes)
        if len(shape) > 1:
            raise ShapeError(
                f"found shape {shape}; expected a scalar or a vector. Give each row its own block.",
                block=block.label,
                port=self.like,
            )
        row = super().start_value(block, shapes)
        return np.array(np.broadcast_to(row, (block.kept, *row.shape)))


class PastInputs(StartsAtInput, Block):
    """Base of the blocks whose output is made of the last inputs, ``kept`` of them, which a tick moves on by one."""

    u = Input(shape=None, description="signal to remember, a scalar or a vector")
    line = History(start="initial_value", like="u", description="the last inputs, the oldest first, one row for each")

    @property
    def kept(self) -> int:
        """Number of past inputs that are remembered."""
        raise NotImplementedError

    def initial(self, u: Any) -> Array:
        """Return the state at the start: the input just before it in all rows."""
        return np.stack([u.u] * self.kept)

    def update(self, t: Array, x: Any, u: Any) -> Array:
        """Return the history with this input and without the oldest."""
        return np.concatenate([x.line[1:], np.stack([u.u])])
