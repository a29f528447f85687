"""Derivatives along a chain of ticks: of any quantity, by the chain's state before a tick and by injected signals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(eq=False)
class Slopes:
    """Derivatives of a quantity at a tick or after it: by the state just before the tick, and by the signals d."""

    by_state: np.ndarray
    by_d: np.ndarray

    __array_ufunc__ = None  # so that M @ slopes is taken by __rmatmul__

    def __rmatmul__(self, M: np.ndarray) -> Slopes:
        return Slopes(M @ self.by_state, M @ self.by_d)

    def __add__(self, other: Slopes) -> Slopes:
        return Slopes(self.by_state + other.by_state, self.by_d + other.by_d)

    def hold(self, rows: Sequence[int], first: int) -> None:
        """Let entries of the quantity be those that the state has of it, whose first entry there is ``first``."""
        self.by_state[rows], self.by_d[rows] = 0.0, 0.0
        self.by_state[rows, [first + i for i in rows]] = 1.0

    @classmethod
    def stack(cls, parts: Sequence[Slopes]) -> Slopes:
        """Return the slopes of quantities one after the other."""
        return cls(np.vstack([part.by_state for part in parts]), np.vstack([part.by_d for part in parts]))

    @classmethod
    def split(cls, both: np.ndarray, states: int) -> Slopes:
        """Return slopes from a matrix with those by so many states and those by d side by side."""
        return cls(both[:, :states], both[:, states:])

    @property
    def side_by_side(self) -> np.ndarray:
        """The slopes as one matrix."""
        return np.hstack([self.by_state, self.by_d])
