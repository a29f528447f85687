"""Functions of a diagram in stages, and the derivative of one, compiled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..flat import Schedule
from .bound_functions import CompiledFunction


@dataclass(frozen=True, eq=False)
class Staged:
    """A schedule whose traced stages were compiled.

    Attributes
    ----------
    schedule : Schedule
        The schedule.
    functions : sequence of CompiledFunction
        Its traced stages, in their order.
    """

    schedule: Schedule
    functions: Sequence[CompiledFunction]

    @property
    def operations(self) -> int:
        """Operations of one evaluation, without those of the FMUs."""
        return sum(function.operations for function in self.functions)

    @property
    def pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of each entry: none, it is no derivative."""
        return np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.int32)


@dataclass(frozen=True, eq=False)
class StagedSlopes:
    """The derivative of staged rates by the integrated states, by differences.

    Attributes
    ----------
    rates : Staged
        The rates.
    where : ndarray of int
        Entries of x that are integrated.
    rows : sequence of ndarray
        Rates that may depend on each of them.
    """

    rates: Staged
    where: np.ndarray
    rows: Sequence[np.ndarray]

    @staticmethod
    def of(rates: Staged, where: np.ndarray, *, looped: bool = False) -> StagedSlopes:
        """Return them for rates and the entries of x that are integrated; loops may lead from each to each."""
        depends = np.ones((where.size, where.size), bool) if looped else rates.schedule.depends("dx", "x")[:, where]
        return StagedSlopes(rates, where, [np.flatnonzero(column).astype(np.int32) for column in depends.T])

    @property
    def operations(self) -> int:
        """Operations of one evaluation."""
        return (1 + len(self.rows)) * self.rates.operations

    @property
    def pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of each entry."""
        columns = np.repeat(np.arange(len(self.where)), [len(own) for own in self.rows])
        return np.concatenate([np.zeros(0, dtype=np.int32), *self.rows]), columns


@dataclass(frozen=True, eq=False)
class StagedEquations:
    """The mismatch of algebraic loops in stages, and its derivative by their values, by differences.

    Attributes
    ----------
    mismatch : Staged
        The mismatch.
    where : sequence of int
        Entries of x that hold the values.
    """

    mismatch: Staged
    where: Sequence[int]
