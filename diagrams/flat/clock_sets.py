"""The sets of clocks that act together, for loops in C over many ticks."""

from __future__ import annotations

import numpy as np

from .clocks import TickPattern, bits_of
from .layout import FlatLayout

_EXACT = 2**53  # up to which every integer is a float64
_MOST_TICKS = 2**20


def is_exact(flat: FlatLayout, last: int) -> bool:
    """Whether times up to a tick are quotients of integers that a float64 holds."""
    return max(flat.base.denominator, last * flat.base.numerator) < _EXACT


def kinds_of(flat: FlatLayout, *, every: bool) -> list[frozenset[TickPattern]]:
    """Return the sets of clocks that act together at some tick, as far as they are found in the first million."""
    clocks = flat.distinct
    period = int(np.lcm.reduce([1, *(clock.every for clock in clocks)]))
    ticks = np.arange(min(max((clock.offset for clock in clocks), default=0) + period + 1, _MOST_TICKS))
    masks = np.unique(bits_of(clocks, ticks)).tolist()
    found = [frozenset(c for i, c in enumerate(clocks) if mask >> i & 1) for mask in masks]
    return [acting for acting in found if acting or every or not clocks]
