"""Where things stand in the flat vectors of a diagram, and at which ticks boxes act."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core.ports import Shape
from ...blocks.tracing.symbols import size


@dataclass(frozen=True)
class Layout:
    """Where things stand in a flat vector: slice and shape by dotted path."""

    slices: dict[str, slice]
    shapes: dict[str, Shape]

    @classmethod
    def of(cls, shapes: Mapping[str, Shape], offset: int = 0) -> Layout:
        """Lay out the given shapes one after the other."""
        slices = {}
        for name, shape in shapes.items():
            slices[name] = slice(offset, offset + size(shape))
            offset += size(shape)
        return cls(slices, dict(shapes))

    @property
    def total(self) -> int:
        """Number of entries, counted from the first slice."""
        bounds = [*self.slices.values()]
        return bounds[-1].stop - bounds[0].start if bounds else 0


@dataclass(frozen=True)
class Clock:
    """The ticks at which a box acts: ``offset``, ``offset + every``, …, on the common base."""

    every: int = 1
    offset: int = 0

    def acts(self, k: int) -> bool:
        """Whether it acts at tick ``k``."""
        return k >= self.offset and (k - self.offset) % self.every == 0

    def after(self, k: int) -> int:
        """Return the first of its ticks after tick ``k``."""
        return self.offset if k < self.offset else k + self.every - (k - self.offset) % self.every


@dataclass(frozen=True)
class FlatEvent:
    """An event of the flattened diagram: of a block, or of a box that is enabled or triggered in continuous time."""

    path: str
    name: str
    direction: str
    hysteresis: float
    box: bool


def rows(vector: Any, where: slice) -> Any:
    """Return a part of a column; an empty one stays a column, which slicing a single entry would not give."""
    if isinstance(vector, np.ndarray):
        return vector[where]
    return vector[where] if where.stop > where.start else ca.MX(0, 1)
