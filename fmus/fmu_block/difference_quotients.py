"""Difference quotients of an FMU's results, with an estimate of their error, over the lengths that tell most.

Values may be rounded more coarsely than to double precision: an FMU may compute in single precision, next to a large
offset, or give out the numbers of a converter. They are stairs then, and a short difference sees one step or none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ...blocks.core import Layout, LoopwrightError
from ...blocks.tracing import extrapolate
from ..archive import FmuDescription

COARSE = 1e-3
"""Error of a derivative, relative to the largest change of its row, from which its values count as coarse."""
SMALL = 1e-6
"""Change of a value, relative to it, below which nothing counts as coarse."""
FAR, FARTHER = 0.1, 0.5
"""Relative distances up to which values are looked at, to tell stairs from straight lines; the second where stairs are
too wide for the first."""
CLEAR, PLAIN = 1e-9, 1e-6
"""Errors of a slope, relative to the values and to the slope, up to which no other length is tried."""
LEVELS = 4
"""Heights between which values that are flat everywhere have to move to be stairs; an end stop or a relay has fewer."""
BENT = 1e-3
"""Distance from the straight line, relative to its rise, up to which a value is straight."""
SLIGHT = 1e-2
"""Step between two heights, relative to their whole range, up to which they are one."""
_PLACES = (0.13, 0.31, 0.47, 0.71, 1.0)
_LONGER = (1e-4, 1e-3, 1e-2, FAR / 4)
_SHORTER = 0.01
"""Lengths besides the first one: longer ones, relative to the size, and a shorter one, relative to the first."""
_EPS = float(np.finfo(float).eps)
_SCATTER = 6.0
"""Size of a rounding in largest distances of the values from a smooth curve."""
_ALL = slice(None)


# --- one argument -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class QuotientSlopes:
    """Slopes of all values (n,) by one argument, and their estimated errors."""

    slope: np.ndarray
    error: np.ndarray


def find_slopes(
    values: Callable[[float], np.ndarray], base: np.ndarray, size: float, first: float, limits: tuple[float, float]
) -> QuotientSlopes:
    """Return the slopes of values at distance 0 along one argument, whose least and largest distances are limits.

    Quotients over d, 2 d and 4 d are extrapolated twice, to order 6 in d (3 if a limit leaves one side only). The
    distance between the extrapolations is an error, and so is the scatter of the values about a smooth curve. Where
    that is coarser than the rounding of double precision, other lengths are tried, and the one with the least error
    counts. A value that is straight at the point, and straight with the same slope at other heights farther away, moves
    in steps: its short differences say nothing.

    ``size`` is that of the argument, ``first`` the length to begin with; one limit is at least four of these away.
    """
    return _AlongArgument(values, base, size, limits).find(first)


@dataclass(frozen=True, eq=False)
class _Quotients:
    """Slopes and their errors over one length, row by row."""

    slope: np.ndarray
    error: np.ndarray

    def choose(self, other: _Quotients, where: np.ndarray) -> _Quotients:
        """Return the slopes with the smaller error; those of ``other`` only in some rows."""
        better = where & (other.error < self.error)
        return _Quotients(*(np.where(better, b, a) for a, b in ((self.slope, other.slope), (self.error, other.error))))


class _AlongArgument:
    """Values along one argument."""

    def __init__(
        self, values: Callable[[float], np.ndarray], base: np.ndarray, size: float, limits: tuple[float, float]
    ):
        self.values, self.base, self.size, self.limits = values, base, size, limits
        self.rounding = np.zeros(base.shape)
        """Rounding of the values, as far as it was seen over any length."""
        self.still = np.zeros(base.shape, bool)
        """Whether a value has not moved at all, as far as it was looked at."""

    def find(self, first: float) -> QuotientSlopes:
        near = self._compare(first)[0]
        reach = np.zeros(self.base.shape)
        with suppress(LoopwrightError):  # it can't be evaluated so far away
            self._find_stairs(near, first, reach)
            exact = np.where(self.still, _EPS * np.abs(self.base) / (FAR * self.size), near.error)
            near = _Quotients(near.slope, exact)
        stairs = reach > 0.0
        with np.errstate(invalid="ignore"):
            clear = near.error * self.size <= CLEAR * np.abs(self.base) + PLAIN * np.abs(near.slope) * self.size
        if np.all(clear & ~stairs):
            return QuotientSlopes(near.slope, near.error)
        best = self._try_other_lengths(near, first, ~clear | stairs, stairs, float(np.max(reach, initial=0.0)))
        unclear = stairs & ~(best.error < 0.5 * np.abs(best.slope))  # the local slope is as good as the mean one
        slope = np.where(unclear, near.slope, best.slope)
        known = np.where(np.isfinite(best.error), np.abs(best.slope - near.slope) + best.error, np.inf)
        return QuotientSlopes(slope, np.where(unclear, known, best.error))

    def _try_other_lengths(
        self, near: _Quotients, first: float, needed: np.ndarray, stairs: np.ndarray, reach: float
    ) -> _Quotients:
        best = _Quotients(near.slope, np.where(stairs, np.inf, near.error))
        lengths = [first, *(k * self.size for k in _LONGER if k * self.size > 2.0 * first)]
        if reach > FAR * self.size:
            lengths.append(reach / 4)
        with suppress(LoopwrightError):  # it can't be evaluated so far away
            for d in lengths:
                if self._sides(4.0 * d):
                    found = self._compare(d)
                    # over a length at which stairs are straight as before, they tell as little
                    straight = np.abs(found[0].slope - near.slope) * d <= self._exactness + near.error * d
                    for other in found:
                        best = best.choose(other, needed & ~(stairs & straight))
        short = first * _SHORTER
        self.rounding = np.zeros(self.base.shape)
        found = self._compare(short)
        return best.choose(found[0], needed & ~stairs & ~self._keeps_slope(found[0], short, 4.0 * first))

    @property
    def _exactness(self) -> np.ndarray:
        return np.asarray(16.0 * _EPS * np.abs(self.base))

    def _at(self, distances: list[float]) -> np.ndarray:
        return np.array([np.array(self.values(d), dtype=float) if d else self.base for d in distances])

    def _sides(self, reach: float) -> list[int]:
        """Return the sides with room for a distance: both, one or none."""
        room = {1: self.limits[1], -1: -self.limits[0]}
        return [side for side in (1, -1) if room[side] >= reach * (1.0 - 1e-9)]

    def _compare(self, d: float) -> tuple[_Quotients, _Quotients]:
        """Return the slopes over a length: extrapolated, and over the whole length, which rounds less."""
        sides = self._sides(4.0 * d)
        if len(sides) == 2:
            found = self._at([k * d for k in (-4, -2, -1, 0, 1, 2, 4)])
            one, two, four = ((found[3 + i] - found[3 - i]) / (2 * k * d) for i, k in ((1, 1), (2, 2), (3, 4)))
            fine, coarse = extrapolate(one, two), extrapolate(two, four)
            best, gains = (16 * fine - coarse) / 15, (0.83, 0.125)
        else:
            side = sides[0]
            found = self._at([side * k * d for k in (0, 1, 2, 4)])
            one, two, four = ((found[i] - found[0]) / (side * k * d) for i, k in ((1, 1), (2, 2), (3, 4)))
            fine, coarse = 2 * one - two, 2 * two - four
            best, gains = (4 * fine - coarse) / 3, (8.6, 0.5)
        scatter = _SCATTER * np.max(np.abs(_RESIDUALS[len(sides)] @ (found - self.base)), axis=0)
        rounding = np.maximum.reduce([scatter, _find_grain(found), self.rounding])
        self.rounding = rounding
        least = _EPS * (np.max(np.abs(found), axis=0) + 2.0 * self.size * np.abs(best)) / d
        return (
            _Quotients(best, np.abs(fine - coarse) + gains[0] * rounding / d + least),
            _Quotients(four, 2.0 * np.abs(four - two) + gains[1] * rounding / d + least),
        )

    # --- stairs ------------------------------------------------------------------------------------------------------

    def _keeps_slope(self, near: _Quotients, d: float, far: float) -> np.ndarray:
        """Return the rows that have their slope over the length d at a far place, too, but another height there.

        That no line and no smooth curve has: it is a step.
        """
        found, sides = np.zeros(self.base.shape, bool), self._sides(far + 2.0 * d)
        still, seen = (near.slope == 0.0) & (self.rounding == 0.0) & bool(sides), found.copy()
        for side in sides:
            there = self._at([side * far])[0]
            still &= there == self.base
            rise = near.slope * side * far
            rounding = 16.0 * _EPS * np.maximum(np.abs(self.base), np.abs(there))
            off = np.abs(there - self.base - rise)
            moved = ~seen & (off > np.maximum(BENT * np.abs(rise), 4.0 * rounding + near.error * far))
            if not moved.any():
                continue
            beyond = self._at([side * (far + k * d) for k in (1, 2)])
            for low, high in ((there, beyond[0]), (beyond[0], beyond[1])):
                same = np.abs(high - low - near.slope * side * d) <= rounding + near.error * d
                found |= moved & same
            seen |= moved
        self.still = still
        return found

    def _find_stairs(self, near: _Quotients, d: float, reach: np.ndarray) -> None:
        """Note for each row how far its stairs were followed, and their height; 0 for rows that don't move in steps."""
        suspect = self._keeps_slope(near, d, FAR * self.size)
        for far in (FAR * self.size, FARTHER * self.size):
            open_ = suspect & (reach == 0.0)
            sides = self._sides(far)
            if not open_.any() or not sides:
                break
            distances = [0.0, *(side * far * k for side in sides for k in _PLACES)]
            heights = self._at(distances) - np.outer(distances, near.slope)
            steps = np.diff(np.sort(heights, axis=0), axis=0)
            apart = steps > self._exactness + near.error * far + SLIGHT * np.sum(steps, axis=0)
            found = open_ & (np.sum(apart, axis=0) >= LEVELS - 1)
            reach[found] = far
            height = np.min(np.where(apart, steps, np.inf), axis=0)
            self.rounding = np.where(found, np.maximum(self.rounding, height), self.rounding)


def _residual_of(points: list[float], degree: int) -> np.ndarray:
    """Return the matrix from values at points to their distances from the polynomial that fits them best."""
    Q = np.linalg.qr(np.vander(np.array(points) / 4.0, degree + 1))[0]
    return np.asarray(np.eye(len(points)) - Q @ Q.T)


_RESIDUALS = {2: _residual_of([-4, -2, -1, 0, 1, 2, 4], 3), 1: _residual_of([0, 1, 2, 4], 2)}


def _find_grain(values: np.ndarray) -> np.ndarray:
    """Return the largest power of two that all values of a column are multiples of; 0 for one or two of them.

    For numbers in single precision it is that of their last place.
    """
    mantissa, exponent = np.frexp(np.where(np.isfinite(values), values, 0.0))
    digits = np.ldexp(mantissa, 53).astype(np.int64)
    lowest = np.ldexp((digits & -digits).astype(float), exponent - 53)
    grain = np.min(np.where(digits == 0, np.inf, lowest), axis=0)
    many = np.sum(np.diff(np.sort(values, axis=0), axis=0) != 0.0, axis=0) >= 2
    return np.where(many & np.isfinite(grain), grain, 0.0)


# --- all arguments ----------------------------------------------------------------------------------------------------


class Column:
    """Elements of variables that are moved one at a time about a point.

    They move by ``relative`` times an element's nominal value, or its value if that is larger.
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
    """Derivatives by differences, and the values at the point."""

    J: np.ndarray
    error: np.ndarray  # estimates, as J: (n, m)
    sizes: np.ndarray  # (m,) sizes of what was moved; 0 of columns that were not
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
    """Return the derivatives of ``evaluate(name, all_elements)``, and the error of each; see `find_slopes`."""
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
