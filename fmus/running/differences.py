"""Difference quotients of an FMU's results, with an estimate of their error."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from ...blocks.core import Layout
from ..archive import FmuDescription

_EPS = float(np.finfo(float).eps)


class Column:
    """Elements of variables that are moved one at a time about a point.

    Parameters
    ----------
    about : FmuDescription
        Description with nominal values and bounds.
    names : list of str
        The variables.
    at : array
        All elements at the point.
    relative : float
        Distance to move, relative to an element's nominal value, or to its value if that is larger.
    """

    def __init__(self, about: FmuDescription, names: list[str], at: np.ndarray, relative: float):
        self.variables, self.at, self.relative = {name: about.find(name) for name in names}, at, relative
        self._slices = Layout.of({n: v.shape for n, v in self.variables.items()}).slices

    def part(self, name: str, values: np.ndarray) -> np.ndarray:
        """Return the elements of one variable."""
        return values[self._slices[name]]

    def __iter__(self) -> Iterator[tuple[str, int, float, int]]:
        """Yield variable, element, distance and side: 0 for both sides, ±1 if a bound leaves one only."""
        for name, variable in self.variables.items():
            where = self._slices[name]
            bounds = (np.ravel(values).tolist() for values in (*variable.limits, variable.nominals))
            for i, low, high, nominal in zip(range(where.start, where.stop), *bounds, strict=True):
                x = float(self.at[i])
                d = self.relative * max(abs(x), nominal)
                d = (x + d) - x  # the distance of two floating-point numbers near x
                up, down = x + 4 * d <= high, x - 4 * d >= low
                yield name, i, d, 0 if up and down else 1 if up else -1


def differentiate(
    column: Column, values: np.ndarray, evaluate: Callable[[str, np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix of derivatives and the estimated error of each entry.

    Quotients over d, 2 d and 4 d are extrapolated twice, to order 6 in d (3 if a bound leaves one side only). The
    estimate is the change by the last extrapolation, plus eps max abs(f) / d for rounding.
    """
    found, errors = [], []
    for name, i, d, side in column:

        def evaluate_moved(steps: int, name: str = name, i: int = i, d: float = d) -> np.ndarray:
            x = column.at.copy()
            x[i] += steps * d
            return evaluate(name, x)

        if side == 0:
            one, two, four = ((evaluate_moved(k) - evaluate_moved(-k)) / (2 * k * d) for k in (1, 2, 4))
            fine, coarse = (4 * one - two) / 3, (4 * two - four) / 3
            best = (16 * fine - coarse) / 15
        else:
            one, two, four = ((evaluate_moved(side * k) - values) / (side * k * d) for k in (1, 2, 4))
            fine, coarse = 2 * one - two, 2 * two - four
            best = (4 * fine - coarse) / 3
        found.append(best)
        errors.append(np.abs(best - fine) + _EPS * np.abs(values).max(initial=0.0) / d)
    shape = (len(found), values.size)
    return np.array(found).reshape(shape).T, np.array(errors).reshape(shape).T
