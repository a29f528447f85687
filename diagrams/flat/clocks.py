"""Clocks: at which ticks of the common base something acts. Pure data."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TickPattern:
    """The ticks at which a sampled subsystem acts: ``offset``, ``offset + every``, …, on the common base."""

    every: int = 1
    offset: int = 0

    def acts(self, k: int) -> bool:
        """Whether it acts at tick ``k``."""
        return k >= self.offset and (k - self.offset) % self.every == 0

    def after(self, k: int) -> int:
        """Return the first of its ticks after tick ``k``."""
        return self.offset if k < self.offset else k + self.every - (k - self.offset) % self.every


NONE: frozenset[TickPattern] = frozenset()
"""The clocks that act between two ticks."""
EVERY = TickPattern()
"""The clock that acts at every tick."""


def in_order(clocks: frozenset[TickPattern] | set[TickPattern]) -> tuple[TickPattern, ...]:
    """Return clocks in an order of their own, fastest first."""
    return tuple(sorted(clocks, key=lambda c: (c.every, c.offset)))
