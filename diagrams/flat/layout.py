"""Where things stand in the flat vectors of a diagram, and at which ticks boxes act."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core.layout import Layout
from ...blocks.core.ports import Shape
from ..wiring.structure import join


@dataclass(frozen=True)
class StateLayout(Layout):
    """Where the states of blocks stand: by the block's path, and within a block by the state's name.

    Attributes
    ----------
    slices, shapes : dict
        All states of a block together: a slice, and the shape (n,), by path.
    of_block : dict
        By path, the layout of a block's states in the same vector: ``of_block["pid"].slices["integral"]``.
    """

    of_block: dict[str, Layout]

    @classmethod
    def of_blocks(cls, shapes: Mapping[str, Mapping[str, Shape]], offset: int = 0) -> StateLayout:
        """Lay out the states of blocks, whose shapes are given by path and name, one block after the other."""
        of_block, first = {}, offset
        for path, states in shapes.items():
            of_block[path] = Layout.of(states, offset)
            offset += of_block[path].total
        blocks = Layout.of({path: (own.total,) for path, own in of_block.items()}, first)
        return cls(blocks.slices, blocks.shapes, of_block)

    @property
    def each(self) -> Layout:
        """The layout of all states, by ``path.name``."""
        names = [(join(path, name), own, name) for path, own in self.of_block.items() for name in own.slices]
        return Layout({full: own.slices[n] for full, own, n in names}, {full: own.shapes[n] for full, own, n in names})

    @property
    def labels(self) -> list[str]:
        """Names of all entries: ``path.name``, with the index of an element behind it."""
        return self.each.labels


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
