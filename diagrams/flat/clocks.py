"""Clocks: at which ticks of the common base something acts. Pure data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class TickPattern:
    """The ticks at which a sampled subsystem acts: ``offset``, ``offset + every``, …, on the common base."""

    every: int = 1
    offset: int = 0

    def acts(self, k: int) -> bool:
        """Whether it acts at tick ``k``."""
        return k >= self.offset and (k - self.offset) % self.every == 0

    def among(self, ticks: np.ndarray) -> np.ndarray:
        """Return at which of some ticks it acts."""
        if self.every == 1:
            return np.asarray(ticks >= self.offset)
        return np.asarray((ticks >= self.offset) & ((ticks - self.offset) % self.every == 0))

    def after(self, k: int) -> int:
        """Return the first of its ticks after tick ``k``."""
        return self.offset if k < self.offset else k + self.every - (k - self.offset) % self.every

    def latest(self, k: int) -> int:
        """Return the last of its ticks up to tick ``k``; -1 if there is none."""
        return -1 if k < self.offset else k - (k - self.offset) % self.every


NONE: frozenset[TickPattern] = frozenset()
"""The clocks that act between two ticks."""
EVERY = TickPattern()
"""The clock that acts at every tick."""


def ticks_after(patterns: Sequence[TickPattern], k: int, last: int, count: int) -> np.ndarray:
    """Return the first ``count`` ticks (int64) of some patterns after tick ``k``, up to ``last``, which ends them."""
    first = [pattern.after(k) for pattern in patterns]
    every = min(pattern.every for pattern in patterns)
    beyond = min(last, min(first) + count * every)  # the fastest has as many by then, or another one begins earlier
    found = [np.arange(a, beyond, p.every, dtype=np.int64) for a, p in zip(first, patterns, strict=True)]
    ticks = found[0] if len(found) == 1 else np.unique(np.concatenate(found))
    if beyond == last and k < last and len(ticks) < count:
        return np.append(ticks, last)
    return ticks[:count]


def in_order(clocks: frozenset[TickPattern] | set[TickPattern]) -> tuple[TickPattern, ...]:
    """Return clocks in their own order, fastest first."""
    return tuple(sorted(clocks, key=lambda c: (c.every, c.offset)))


class ClockSets:
    """Numbers of sets of clocks that act together; ``rest`` is that of all others.

    The sets are a tree that branches at each clock: to sets in which it acts, and to those in which it doesn't. So
    there may be any number of clocks.
    """

    def __init__(self, clocks: Sequence[TickPattern], sets: Mapping[frozenset[TickPattern], int], rest: int = -1):
        self._clocks = tuple(clocks)
        self._branches: list[np.ndarray] = []
        nodes: dict[tuple[bool, ...], int] = {(): 0}  # of each level, by whether the clocks so far act
        for i in range(len(self._clocks)):
            following: dict[tuple[bool, ...], int] = {}
            for acting in sets:
                following.setdefault(tuple(c in acting for c in self._clocks[: i + 1]), len(following))
            branches = np.full((len(nodes) + 1, 2), len(following), dtype=np.int32)  # the last node leads to no set
            for path, node in following.items():
                branches[nodes[path[:-1]], int(path[-1])] = node
            self._branches.append(branches)
            nodes = following
        self._numbers = np.full(len(nodes) + 1, rest, dtype=np.int32)
        for acting, number in sets.items():
            self._numbers[nodes[tuple(c in acting for c in self._clocks)]] = number

    def at(self, ticks: np.ndarray) -> np.ndarray:
        """Return the number of the set that acts at each of some ticks."""
        node = np.zeros(len(ticks), dtype=np.int32)
        for clock, branches in zip(self._clocks, self._branches, strict=True):
            node = branches[node, clock.among(ticks).view(np.int8)]
        found: np.ndarray = self._numbers[node]
        return found
