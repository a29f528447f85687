"""The sets of clocks that act together, for loops in C over many ticks."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from .clocks import TickPattern
from .flat_layout import FlatLayout

_EXACT = 2**53  # up to which every integer is a float64
_MOST_TICKS, _MOST_SETS = 2**20, 256
_AT_ONCE = 32  # clocks whose bits are looked at together


def times_of(flat: FlatLayout, ticks: np.ndarray) -> np.ndarray:
    """Return the times of ticks, or lengths of so many ticks, in s: each the float64 that is nearest."""
    n, d = flat.base.numerator, flat.base.denominator
    if max(d, int(ticks.max(initial=0)) * n) < _EXACT:  # quotients of integers that a float64 holds
        return np.asarray(ticks * n / d)
    return np.array([k * n / d for k in ticks.tolist()])


def kinds_of(flat: FlatLayout, *, every: bool) -> list[frozenset[TickPattern]]:
    """Return the sets of clocks that act together at some of the first million ticks; of very many the commonest.

    That of no clock is one of them where ticks are visited at which nothing but a plant has to do.
    """
    idle = every or not flat.distinct or not {*flat.visited} <= {*flat.distinct}
    return [acting for acting in _sets_of(flat.distinct) if acting or idle]


def bits_of(flat: FlatLayout, acting: frozenset[TickPattern]) -> int:
    """Return a set of clocks as bits, in the order of the diagram's clocks."""
    return sum(1 << i for i, clock in enumerate(flat.distinct) if clock in acting)


def has_all_kinds(flat: FlatLayout) -> bool:
    """Whether all sets of clocks that ever act together do so in the first million ticks."""
    return _ticks_until_again(flat.distinct) <= _MOST_TICKS


def _ticks_until_again(clocks: Sequence[TickPattern]) -> int:
    """Return the number of ticks after which the sets of clocks that act together repeat."""
    period = int(np.lcm.reduce([1, *(clock.every for clock in clocks)], dtype=object))
    return max((clock.offset for clock in clocks), default=0) + period + 1


@lru_cache(maxsize=64)
def _sets_of(clocks: Sequence[TickPattern]) -> list[frozenset[TickPattern]]:
    ticks = np.arange(min(_ticks_until_again(clocks), _MOST_TICKS))
    group = np.zeros(len(ticks), dtype=np.int64)  # ticks at which the same clocks act, from the last clock on
    for end in range(len(clocks), 0, -_AT_ONCE):
        bits = group << _AT_ONCE
        for i, clock in enumerate(clocks[max(0, end - _AT_ONCE) : end]):
            bits[clock.offset :: clock.every] |= 1 << i
        group = np.unique(bits, return_inverse=True)[1]
    _, first, count = np.unique(group, return_index=True, return_counts=True)
    commonest = np.sort(np.argsort(-count, kind="stable")[:_MOST_SETS])
    return [frozenset(c for c in clocks if c.acts(k)) for k in ticks[first[commonest]].tolist()]
