"""Difference quotients of what an FMU computes, with an estimate of their error."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from ._description_reading import FmuDescription

_EPS = float(np.finfo(float).eps)


class Column:
    """The elements of variables to be moved, one at a time, about a point.

    Parameters
    ----------
    about : FmuDescription
        Of nominal values and bounds.
    names : list of str
        The variables.
    at : array
        All their elements.
    relative : float
        How far to move, relative to an element's nominal value, or its value where that is larger.
    """

    def __init__(self, about: FmuDescription, names: list[str], at: np.ndarray, relative: float):
        self.variables, self.at, self.relative = {name: about.variables[name] for name in names}, at, relative
        sizes = [v.size for v in self.variables.values()]
        first = np.cumsum([0, *sizes])
        self._slices = {n: slice(int(a), int(b)) for n, a, b in zip(names, first, first[1:], strict=False)}

    def part(self, name: str, values: np.ndarray) -> np.ndarray:
        """Return the elements of one variable."""
        return values[self._slices[name]]

    def __iter__(self) -> Iterator[tuple[str, int, float, int]]:
        """Yield variable, element, distance and side: 0 for both, ±1 where a bound leaves one."""
        for name, variable in self.variables.items():
            low = -np.inf if variable.minimum is None else variable.minimum
            high = np.inf if variable.maximum is None else variable.maximum
            for i in range(self._slices[name].start, self._slices[name].stop):
                x = float(self.at[i])
                d = self.relative * max(abs(x), abs(variable.nominal or 1.0))
                d = (x + d) - x  # a distance that the numbers near x have
                up, down = x + 2 * d <= high, x - 2 * d >= low
                yield name, i, d, 0 if up and down else 1 if up else -1


def columns(
    column: Column, values: np.ndarray, evaluate: Callable[[str, np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix of derivatives and the estimated error of each entry.

    Quotients over d and 2 d are extrapolated, to order 4 in d (order 2 where a bound leaves one side). The difference
    to the quotient over d bounds the error of smooth functions from above; what rounding adds is eps max abs(f) / d.
    """
    found, errors = [], []
    for name, i, d, side in column:

        def moved(steps: int, name: str = name, i: int = i, d: float = d) -> np.ndarray:
            x = column.at.copy()
            x[i] += steps * d
            return evaluate(name, x)

        if side == 0:
            near, far = (moved(1) - moved(-1)) / (2 * d), (moved(2) - moved(-2)) / (4 * d)
            best = (4 * near - far) / 3
        else:
            near, far = (moved(side) - values) / (side * d), (moved(2 * side) - values) / (2 * side * d)
            best = 2 * near - far
        found.append(best)
        errors.append(np.abs(best - near) + _EPS * np.abs(values).max(initial=0.0) / d)
    shape = (len(found), values.size)
    return np.array(found).reshape(shape).T, np.array(errors).reshape(shape).T
