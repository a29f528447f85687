"""Directional derivatives of an FMU, held against differences of its own values."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, replace

import numpy as np

from ...blocks.core import LoopwrightError
from ...blocks.tracing import extrapolate
from .derivation import Derivation, DerivativeMethod

SAME = 1e-10
"""Distance between a derivative and its difference, relative to their size, that counts as none."""
SHARP, CLEAR = 1e-9, 1e-6
"""Errors of a difference, relative to the values, at which it needs no other length, and at which it can agree."""
WRONG = 1e-4
"""Distance beyond which a derivative is plainly wrong, if the difference is ten times better."""
STEADY = 1e-2
"""Relative distance of differences over two lengths that are evidence together."""
DIRECTIONS = 3
"""Random directions in which a derivative is checked."""
_LENGTHS = (1e-5, 1e-3, 1e-7)
"""Relative lengths of differences, tried one after the other: long ones round less, short ones keep off kinks."""
_FAR, _ALIKE = 0.1, 0.2
"""Relative length over which stairs, as of single precision, look straight, and the distance at which they do."""
_EPS = float(np.finfo(float).eps)


@dataclass(frozen=True, eq=False)
class SlopeCheck:
    """Directional derivatives after their check."""

    J: np.ndarray  # with differences in place of those that are plainly wrong
    # estimate of each entry; 0 where the derivative agrees with its difference, NaN where that is no evidence
    error: np.ndarray = field(repr=False)
    # largest distance from a difference, relative to the values' change; 0 if all agree, NaN without evidence
    gap: float
    is_wrong: bool  # whether some derivatives are plainly wrong

    def describe(self, derivation: Derivation) -> Derivation:
        """Return the method of the derivatives, after this check of directional ones."""
        if self.is_wrong:
            return replace(derivation, method=DerivativeMethod.DIFFERENCES, gap=self.gap, refuted=True)
        return replace(derivation, gap=self.gap)


def check_slopes(
    J: np.ndarray,
    values: Callable[[np.ndarray], np.ndarray],
    at: np.ndarray,
    nominals: np.ndarray,
    limits: tuple[np.ndarray, np.ndarray],
    moved: np.ndarray,
) -> SlopeCheck:
    """Hold derivatives against differences of the values, in a few random directions.

    Only where a direction shows a gap, each column is looked at by itself. A derivative that is the slope to one side
    of a kink is right; one between both sides, such as their mean, is kept, with its distance as its error.
    ``nominals`` are sizes of the entries of ``at``, ``moved`` those that may be moved.
    """
    agreed = SlopeCheck(J, np.zeros(J.shape), 0.0, False)
    checker = _Checker(values, at, nominals, limits, moved)
    if not J.size or not checker.moved.any():
        return agreed
    try:
        checker.base = np.array(values(at), dtype=float)
        if all(checker.compare(J, v).agrees.all() for v in checker.directions()):
            return agreed
        return checker.check_columns(J)
    except LoopwrightError:  # the FMU can't be evaluated next to this point: nothing is known
        return SlopeCheck(J, np.where(checker.moved, np.nan, agreed.error), np.nan, False)


@dataclass(frozen=True, eq=False)
class _Comparison:
    """A derivative along a direction and its difference, row by row."""

    slope: np.ndarray
    """The difference."""
    error: np.ndarray
    """Its own error."""
    gap: np.ndarray
    """Distance of the derivative from it, at a kink from the nearer side's."""
    size: np.ndarray
    """Size of the derivative."""
    whole: np.ndarray
    """Size of the derivative and of the values."""
    rounding: np.ndarray
    """Part of the error that rounding makes."""
    between: np.ndarray
    """Whether the point is a kink, and the derivative lies between the slopes to its sides."""

    @property
    def is_close(self) -> np.ndarray:
        return np.asarray(self.gap <= SAME * self.size + 3.0 * self.error)

    @property
    def agrees(self) -> np.ndarray:
        return np.asarray(self.is_close & (self.error <= CLEAR * self.whole))

    @property
    def is_wrong(self) -> np.ndarray:
        off = (self.gap > WRONG * self.size) & (self.gap > 10.0 * self.error)
        return np.asarray(~self.agrees & off & ~self.between)

    def choose(self, other: _Comparison) -> _Comparison:
        """Return, row by row, the comparison with the smaller error."""
        better = (other.error < self.error) | ~np.isfinite(self.error)
        pairs = ((getattr(other, f.name), getattr(self, f.name)) for f in fields(self))
        return _Comparison(*(np.where(better, new, old) for new, old in pairs))


class _Checker:
    """Differences of values about a point."""

    def __init__(
        self,
        values: Callable[[np.ndarray], np.ndarray],
        at: np.ndarray,
        nominals: np.ndarray,
        limits: tuple[np.ndarray, np.ndarray],
        moved: np.ndarray,
    ):
        self.values, self.at, self.base = values, at, np.zeros(0)
        self.limits = limits
        self.sizes = np.maximum(np.abs(at), nominals)
        reach = 4.0 * max(_LENGTHS) * self.sizes
        self.up, self.down = at + reach <= limits[1], at - reach >= limits[0]
        self.moved = moved & (self.up | self.down)

    def directions(self) -> Iterator[np.ndarray]:
        """Yield directions that move all entries; those next to a limit away from it."""
        rng = np.random.default_rng(0)
        for _ in range(DIRECTIONS):
            sign = np.where(self.up & self.down, rng.choice([-1.0, 1.0], self.at.size), np.where(self.up, 1.0, -1.0))
            yield np.where(self.moved, sign * rng.uniform(0.5, 1.0, self.at.size) * self.sizes, 0.0)

    def compare(self, J: np.ndarray, v: np.ndarray) -> _Comparison:
        """Compare the derivatives along a direction with differences, at the length that shows most."""
        found = self._compare_at(J, v, _LENGTHS[0])
        for length in _LENGTHS[1:]:
            if np.all(found.is_close & (found.error <= SHARP * found.whole)):
                break
            found = found.choose(self._compare_at(J, v, length))
        return found

    def _compare_at_all(self, J: np.ndarray, v: np.ndarray) -> tuple[_Comparison, np.ndarray]:
        """Return the best comparison of all lengths, and in which rows another length has the same difference.

        Differences over lengths at which the function does not look straight, by a nominal value that is far too
        large, are no evidence.
        """
        every = [self._compare_at(J, v, length) for length in _LENGTHS]
        found = every[0]
        for other in every[1:]:
            found = found.choose(other)
        close = [np.abs(c.slope - found.slope) <= STEADY * np.abs(found.slope) + c.rounding for c in every]
        return found, np.sum(close, axis=0) > 1

    def _compare_at(self, J: np.ndarray, v: np.ndarray, length: float) -> _Comparison:
        """Compare with differences over one length.

        Quotients over d, 2 d and 4 d are extrapolated twice, to order 6 in d, and to 3 where one side alone is there.
        """
        f0, by_slopes, size = self.base, J @ v, np.abs(J) @ np.abs(v)
        both = bool(np.all((self.up & self.down) | (v == 0.0)))
        ends = {k: self._value(k * length * v) for k in ((1, 2, 4, -1, -2, -4) if both else (1, 2, 4))}
        largest = np.max(np.abs([f0, *ends.values()]), axis=0)
        rounding = 4.0 * _EPS * (largest + size) / length  # of the values, and of the argument's steps
        sides = []
        for side in (1, -1) if both else (1,):
            one, two, four = ((ends[side * k] - f0) / (side * k * length) for k in (1, 2, 4))
            fine, coarse = 2 * one - two, 2 * two - four
            last = (4 * fine - coarse) / 3
            sides.append((last, 2.0 * np.abs(last - fine) + rounding))
        slope, error = sides[0]
        gap = np.abs(by_slopes - slope)
        between = np.zeros(gap.shape, bool)
        if both:
            one, two, four = ((ends[k] - ends[-k]) / (2 * k * length) for k in (1, 2, 4))
            fine, coarse = extrapolate(one, two), extrapolate(two, four)
            middle, middle_error = (16 * fine - coarse) / 15, 0.5 * np.abs(fine - coarse) + rounding
            (up, up_error), (down, down_error) = sides
            kink = np.abs(up - down) > 10.0 * (up_error + down_error)
            below = np.abs(by_slopes - down) < gap
            slope = np.where(kink, np.where(below, down, up), middle)
            error = np.where(kink, np.where(below, down_error, up_error), middle_error)
            gap = np.abs(by_slopes - slope)
            between = kink & (np.minimum(up, down) <= by_slopes) & (by_slopes <= np.maximum(up, down))
        size = np.maximum(size, np.abs(slope))
        error = np.where(np.isfinite(slope) & np.isfinite(error), error, np.inf)
        return _Comparison(slope, error, gap, size, size + np.abs(f0), rounding, between)

    def _value(self, step: np.ndarray) -> np.ndarray:
        return np.array(self.values(self.at + step), dtype=float)

    def _rises(self, slopes: np.ndarray, short: np.ndarray, k: int) -> np.ndarray:
        """Return the rows that follow their slopes over a long way, though they hardly move so over ``short`` ones.

        Values that are rounded more coarsely than double precision stand still over a short way.
        """
        ends = self.at + np.outer((-_FAR, _FAR), np.eye(self.at.size)[k] * self.sizes[k])
        low, high = np.clip(ends, *self.limits)
        try:
            rise = np.array(self.values(high), dtype=float) - np.array(self.values(low), dtype=float)
        except LoopwrightError:
            return np.zeros(slopes.shape, bool)
        expected = slopes * (high - low)[k]
        far_off = np.abs(slopes - short) >= 0.5 * np.abs(slopes)
        return np.asarray(far_off & (np.abs(rise - expected) <= _ALIKE * np.abs(expected)))

    def check_columns(self, J: np.ndarray) -> SlopeCheck:
        """Compare each column by itself; put differences in place of entries that are plainly wrong."""
        made, error, gap, wrong, unknown = J.copy(), np.zeros(J.shape), 0.0, False, np.zeros(J.shape, bool)
        for k in np.flatnonzero(self.moved):
            v = np.zeros(self.at.size)
            v[k] = self.sizes[k] if self.up[k] else -self.sizes[k]
            found, steady = self._compare_at_all(J, v)
            known = np.isfinite(found.error) & (found.agrees | steady | found.between)
            wrong_rows = known & found.is_wrong
            if wrong_rows.any():
                known = known & ~(wrong_rows & self._rises(J[:, k], found.slope / v[k], int(k)))
            unknown[:, k] = ~known
            off, bad = known & ~found.agrees, known & found.is_wrong
            if not off.any():
                continue
            error[off, k] = (found.gap + found.error)[off] / self.sizes[k]
            size = np.maximum(found.size[off], np.finfo(float).tiny)  # 0 where both are none
            gap = max(gap, float(np.max(found.gap[off] / size)))
            made[bad, k], error[bad, k] = found.slope[bad] / v[k], found.error[bad] / self.sizes[k]
            wrong |= bool(bad.any())
        if unknown.any() and not gap:
            error[unknown], gap = np.nan, np.nan
        return SlopeCheck(made, error, gap, wrong)
