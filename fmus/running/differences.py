"""Difference quotients of an FMU's results, with an estimate of their error."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from ...blocks.core import Layout
from ..archive import FmuDescription
from .column_slopes import find_slopes

COARSE = 1e-3
"""Error of a derivative, relative to the largest change of its row, from which its values count as coarse."""
SMALL = 1e-6
"""Change of a value, relative to it, below which nothing counts as coarse."""
_ALL = slice(None)


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

    def __iter__(self) -> Iterator[tuple[str, int, float, tuple[float, float]]]:
        """Yield variable, element, distance, and its least and largest value; without room, some below."""
        for name, variable in self.variables.items():
            where = self._slices[name]
            bounds = (np.ravel(values).tolist() for values in (*variable.limits, variable.nominals))
            for i, low, high, nominal in zip(range(where.start, where.stop), *bounds, strict=True):
                x = float(self.at[i])
                d = self.relative * max(abs(x), nominal)
                d = (x + d) - x  # the distance of two floating-point numbers near x
                has_room = x + 4 * d <= high or x - 4 * d >= low
                yield name, i, d, (low, high) if has_room else (x - 4 * d, x)


@dataclass(frozen=True, eq=False)
class Differences:
    """Derivatives by differences.

    Attributes
    ----------
    J, error : (n, m) ndarray
        The derivatives, and the estimated error of each.
    sizes : (m,) ndarray
        Sizes of what was moved; 0 of columns that were not.
    values : (n,) ndarray
        Values at the point.
    """

    J: np.ndarray
    error: np.ndarray
    sizes: np.ndarray
    values: np.ndarray

    def find_coarseness(self, rows: np.ndarray | slice = _ALL) -> float:
        """Return the largest error of a derivative, relative to the largest change of its row; 0 below `COARSE`.

        It has one where values move in steps, are rounded far more coarsely than to double precision, or have a kink.
        """
        changes, errors = np.abs(self.J[rows]) * self.sizes, self.error[rows] * self.sizes
        whole = (np.max(changes, axis=1, initial=0.0) + SMALL * np.abs(self.values[rows]))[:, None] + errors
        known = (whole > 0.0) & np.isfinite(errors)
        relative = np.where(known, errors, 0.0) / np.where(known, whole, 1.0)
        return float(np.max(relative[relative > COARSE], initial=0.0))

    def place(self, columns: list[int], many: int) -> Differences:
        """Return them as some columns of many; the others are zero."""
        J, error, sizes = np.zeros((len(self.J), many)), np.zeros((len(self.J), many)), np.zeros(many)
        J[:, columns], error[:, columns], sizes[columns] = self.J, self.error, self.sizes
        return Differences(J, error, sizes, self.values)

    def __add__(self, other: Differences) -> Differences:
        return Differences(self.J + other.J, self.error + other.error, self.sizes + other.sizes, self.values)


def differentiate(column: Column, values: np.ndarray, evaluate: Callable[[str, np.ndarray], np.ndarray]) -> Differences:
    """Return the matrix of derivatives and the estimated error of each entry; see `find_slopes`.

    Parameters
    ----------
    column : Column
        The point, and what is moved about it.
    values : (n,) ndarray
        Values at the point.
    evaluate : callable
        Values when the elements of one variable are moved: ``evaluate(name, all_elements)``.
    """
    found, sizes = [], []
    for name, i, d, (low, high) in column:

        def evaluate_moved(by: float, name: str = name, i: int = i, low: float = low, high: float = high) -> np.ndarray:
            x = column.at.copy()
            x[i] = min(max(x[i] + by, low), high)
            return evaluate(name, x)

        sizes.append(d / column.relative)
        found.append(find_slopes(evaluate_moved, values, sizes[-1], d, (low - column.at[i], high - column.at[i])))
    shape = (len(found), values.size)
    J, error = (np.array([getattr(slopes, name) for slopes in found]).reshape(shape).T for name in ("slope", "error"))
    return Differences(J, error, np.array(sizes), values)
