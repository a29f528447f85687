"""A sampled diagram as C for a target: what happens at each kind of tick, as scalar operations with names.

It is plain data, which knows no diagram. `LoopSpec` has the variables and the clocks; here are the functions, each with
the blocks whose outputs it has, so that the C text can have names, and leave out what nobody reads.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .loop_spec import LoopSpec
from .model_spec import Variable
from .scalar_operations import Lookup

CLOCK_LIMIT = 32
"""Clocks of a target: their bits are in one word."""


@dataclass(frozen=True, eq=False)
class BlockOutput:
    """An output of a block.

    ``block``, ``port``, ``kind``: the block's path, the port, and the block's class.
    """

    block: str
    port: str
    kind: str
    first: int
    count: int


@dataclass(frozen=True, eq=False)
class TargetTick:
    """A kind of tick: the clocks of a set act.

    ``acting``: the set, as bits in the order of ``loop.clocks``.
    ``function``: scalar operations ``(t, x, w, p, …) -> (x_next, log, guards, …)``; behind them what `lookups` find,
    and seek.
    ``outputs``: outputs of the blocks that act, in the order of evaluation.
    """

    acting: int
    function: Any
    lookups: tuple[Lookup, ...]
    outputs: tuple[BlockOutput, ...]
    guards: tuple[tuple[str, str], ...]


@dataclass(frozen=True, eq=False)
class Kept:
    """Entries of x that are kept from one tick to the next.

    ``variable``: name, shape, unit, description and start values.
    ``first``: the first entry.
    """

    variable: Variable
    first: int


@dataclass(frozen=True, eq=False)
class TargetNumbers:
    """Numbers that are computed from the parameters of a block, behind these.

    ``first``, ``parameters``, ``count``: entry of p with which the block's parameters begin, their number, and that of
    the computed numbers.
    """

    block: str
    first: int
    parameters: int
    count: int
    function: Any


@dataclass(frozen=True, eq=False, kw_only=True)
class TargetSpec:
    """A sampled diagram as C for a target.

    ``ticks``: its kinds of ticks: each set of clocks that act together is in one of them.
    ``fixed``: entries of p, from one on and up to another, from which numbers are computed here alone: they are
    constants.
    """

    loop: LoopSpec
    ticks: tuple[TargetTick, ...]
    kept: tuple[Kept, ...]
    start: Mapping[str, np.ndarray]
    acting: tuple[tuple[str, ...], ...]
    numbers: tuple[TargetNumbers, ...] = ()
    fixed: tuple[tuple[int, int], ...] = ()

    @property
    def counts_clocks(self) -> bool:
        """Whether a tick has to find out which clocks act; without it, the only one acts at each."""
        return self.loop.clocks != ((1, 0),)

    def describe_clock(self, clock: int) -> str:
        """Return in words when a clock acts."""
        every, offset = self.loop.clocks[clock]
        text = f"every {float(every * self.loop.base):g} s"
        return f"{text} from {float(offset * self.loop.base):g} s on" if offset else text

    def describe_clocks(self, acting: int) -> str:
        """Return in words when a set of clocks, as bits, acts together."""
        return " with ".join(self.describe_clock(i) for i in self._clocks_of(acting)) or "at no clock"

    def acting_at(self, acting: int) -> tuple[str, ...]:
        """Return the names of the subsystems that act with a set of clocks."""
        return tuple(path or "the diagram" for i in self._clocks_of(acting) for path in self.acting[i])

    def _clocks_of(self, acting: int) -> list[int]:
        return [i for i in range(len(self.loop.clocks)) if acting >> i & 1]
