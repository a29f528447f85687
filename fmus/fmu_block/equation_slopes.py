"""Slopes of an FMU's equations: of derivatives and outputs, by states and inputs, at one time with all else constant.

They are computed here alone: for an FMU by itself (`linearization`), and for FMUs in model exchange at a diagram's
operating point (`loopwright.diagrams.linearization.exchanged`). An FMU's own directional derivatives are held against
differences of its values. Differences replace them where the FMU may not be asked for them, and everywhere once they
are plainly wrong. Values and slopes are in the FMU's units: a diagram converts units at the wires.

Jacobians within a run are another thing (`ModelExchangeEvaluator`): Newton's method needs them fast, and only its speed
hangs on their error, which nobody estimates there. A communication step has slopes of its own, too (`linearization`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from ...blocks.core import Layout, Wanted
from ..archive import FmuDescription, FmuVariable
from ..calls import ModelExchangeInstance, is_smooth
from .derivation import Derivation, DerivativeMethod
from .difference_quotients import Column, Differences, differentiate
from .slope_check import SlopeCheck, check_slopes

EQUATIONS = 1e-5
"""Relative distance of differences of equations."""

OwnSlopes: TypeAlias = tuple[np.ndarray, np.ndarray]
"""Directional derivatives of all rows by all columns, and which rows an FMU may be asked for; see `LoadedFmu`."""


@dataclass(frozen=True, eq=False)
class LocalEquations:
    """Equations of an FMU next to a point, as a function of states and inputs.

    Attributes
    ----------
    about : FmuDescription
        The FMU.
    at : ndarray, shape (m,)
        Values of all columns at the point.
    moved : sequence of (FmuVariable, slice)
        Variables that may be moved, and their places among the columns; slopes by the others are zero.
    values : callable
        Values of all rows, of shape (n,), at values of all columns.
    real : ndarray of bool, shape (n,)
        Rows that are real numbers; slopes of the others are zero.
    """

    about: FmuDescription
    at: np.ndarray
    moved: Sequence[tuple[FmuVariable, slice]]
    values: Callable[[np.ndarray], np.ndarray]
    real: np.ndarray

    @classmethod
    def in_exchange(
        cls, instance: ModelExchangeInstance, wanted: Wanted, t: float, x: np.ndarray, u: np.ndarray
    ) -> LocalEquations:
        """Return those of model exchange: the columns are the states x and all inputs u.

        Continuous inputs among the wired ones are moved; to move a discrete one is an event.
        """
        about, n = instance.description, x.size
        every = instance.setup.input_variables
        places = Layout.of({port: v.shape for port, v in every.items()}).slices
        moved = [(about.find(name), where) for name, where in about.layout(about.states).slices.items()]
        for port, v in every.items():
            if port in instance.inputs and is_smooth(v):
                moved.append((v, slice(n + places[port].start, n + places[port].stop)))

        def values(at: np.ndarray) -> np.ndarray:
            return instance.compute(wanted, t, at[:n], at[n:])

        return cls(about, np.concatenate([x, u]), moved, values, real_elements(instance.rows(wanted)))

    def differentiate(self) -> Differences:
        """Return the slopes by differences."""
        names = [v.name for v, _ in self.moved]
        places = np.concatenate([np.zeros(0, dtype=int), *(np.r_[where] for _, where in self.moved)])
        column = Column(self.about, names, self.at[places], EQUATIONS)

        def evaluate(_: str, moved: np.ndarray) -> np.ndarray:
            at = self.at.copy()
            at[places] = moved
            return self.values(at)

        base = self.values(self.at)
        made = differentiate(column, base, evaluate) if names else _none(base)
        made = made.place(places.tolist(), self.at.size)
        made.J[~self.real], made.error[~self.real] = 0.0, 0.0
        return made

    def check(self, J: np.ndarray, rows: np.ndarray) -> SlopeCheck:
        """Hold slopes of some rows against differences."""
        moved = np.zeros(self.at.size, dtype=bool)
        nominals, low, high = np.ones(self.at.size), np.full(self.at.size, -np.inf), np.full(self.at.size, np.inf)
        for v, where in self.moved:
            moved[where], nominals[where] = True, np.ravel(v.nominals)
            low[where], high[where] = (np.ravel(side) for side in v.limits)
        return check_slopes(J, lambda at: self.values(at)[rows], self.at, nominals, (low, high), moved)


def real_elements(variables: Sequence[FmuVariable]) -> np.ndarray:
    """Return which elements of variables are real numbers."""
    return np.concatenate([np.zeros(0, dtype=bool), *(np.full(v.size, not v.is_integer) for v in variables)])


def _none(values: np.ndarray) -> Differences:
    return Differences(np.zeros((values.size, 0)), np.zeros((values.size, 0)), np.zeros(0), values)


class EquationSlopes:
    """Slopes of an FMU's equations at one point after the other, with the method by which they are computed.

    ``has_own`` says whether the FMU computes directional derivatives, ``is_built_here`` whether Loopwright has built
    it, so that they need no check.
    """

    def __init__(self, interface: str, *, has_own: bool, is_built_here: bool):
        method = DerivativeMethod.DIRECTIONAL if has_own else DerivativeMethod.DIFFERENCES
        self.derivation = Derivation(method, interface)
        """Method of the slopes so far; once refuted, the FMU's own are not asked for any more."""
        self._is_trusted, self._checked = is_built_here, set[object]()

    def find(
        self, equations: LocalEquations, own: Callable[[], OwnSlopes | None], rows: object
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the slopes of all rows by all columns, and an estimate of each one's error; see `Derivation`.

        ``own`` computes the FMU's directional derivatives, None if it has none of these rows. They are checked the
        first time that these rows are asked for, which ``rows`` names; an error is NaN where a check is no evidence.
        """
        given = own() if self.derivation.method is DerivativeMethod.DIRECTIONAL else None
        if given is None:
            self.derivation = replace(self.derivation, method=DerivativeMethod.DIFFERENCES)
            made = equations.differentiate()
            self._note_coarseness(made, equations.real)
            return made.J, made.error
        J, known = given
        error = np.zeros(J.shape)
        if not self._is_trusted and rows not in self._checked:
            self._checked.add(rows)
            found = equations.check(J[known], known)
            if found.is_wrong:
                self.derivation = found.describe(self.derivation)
                return self.find(equations, own, rows)
            error[known] = found.error
            if math.isnan(found.gap) or found.gap > self.derivation.gap:
                self.derivation = found.describe(self.derivation)
        others = equations.real & ~known
        if others.any():  # local variables
            made = equations.differentiate()
            J[others], error[others] = made.J[others], made.error[others]
            self._note_coarseness(made, others)
        return J, error

    def _note_coarseness(self, made: Differences, rows: np.ndarray) -> None:
        worst = max(made.find_coarseness(rows), self.derivation.coarseness)
        self.derivation = replace(self.derivation, coarseness=worst)
