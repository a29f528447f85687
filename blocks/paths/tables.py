"""Numerical tables of a path: arc length, reach, sampling, and the searches on them (NumPy only)."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from numpy.polynomial import chebyshev, polynomial

from ..core import ParameterError

UNLIMITED = 1e6
"""Reach of a path without a limit, m: a finite number, so that equations can be traced and compared."""


def replace_unlimited(reach: float) -> float:
    """Return the reach, infinite in place of `UNLIMITED`, for messages."""
    return math.inf if reach >= UNLIMITED * (1.0 - 1e-9) else reach


class Curve(Protocol):
    """The members of a `Path` that its tables need."""

    @property
    def period(self) -> float | None:
        """Period in θ; None for an open path."""

    @property
    def knots(self) -> np.ndarray:
        """Parameters between which σ is smooth."""

    @property
    def length(self) -> float:
        """Length in m."""

    @property
    def sampling(self) -> tuple[np.ndarray, np.ndarray]:
        """Dense parameters, and their arc lengths in m."""

    @property
    def sampled(self) -> np.ndarray:
        """Points at the dense parameters, (2, N), in m."""

    def sigma(self, theta: Any, order: int = 0) -> Any:
        """Return σ(θ), or its derivative of an order."""

    def derivatives(self, theta: Any, highest: int = 3) -> tuple[Any, ...]:
        """Return σ(θ) and its derivatives."""

    def arc_length(self, theta: Any) -> Any:
        """Return the arc length at θ in m."""

    def frame(self, theta: Any) -> Any:
        """Return the moving frame at θ."""


_DEGREE = 12  # of the polynomials that are fitted to the speed
_MOST_MINIMA = 256  # of a sampled distance; more of them are rounding errors, as at the centre of an arc
_CROWDED = 1e9  # 1/m, the largest inverse reach in the table, where a path meets itself
_SLACK = 5e-4  # allowed relative error of the inverse reach between two nodes; it is then added to the table
_GENEROUS = 1e-2  # the same for an error on the safe side


# --- arc length ------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _fit_matrices() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return nodes in [0, 1], and the matrices values → Chebyshev coefficients → powers of the integral from 0."""
    x = chebyshev.chebpts1(_DEGREE + 1)
    analysis = np.linalg.inv(chebyshev.chebvander(x, _DEGREE))
    integrals = np.zeros((_DEGREE + 2, _DEGREE + 1))
    for k in range(_DEGREE + 1):
        powers: np.ndarray = np.zeros(1)
        for c in chebyshev.cheb2poly(np.eye(_DEGREE + 1)[k])[::-1]:  # T_k(2 v − 1) in powers of v, exact in float64
            powers = polynomial.polyadd(polynomial.polymul(powers, [-1.0, 2.0]), [c])
        powers = polynomial.polyint(powers)[: k + 2]
        integrals[: len(powers), k] = powers
    return (x + 1.0) / 2.0, analysis, integrals


def integrate(speed: Callable[[np.ndarray], np.ndarray], knots: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return breaks, coefficients (pieces, 1, powers) and total of the integral of ``speed`` from the first knot on.

    Intervals are halved until the Chebyshev coefficients of the speed on each have decayed to rounding errors.
    """
    nodes, analysis, integrals = _fit_matrices()
    start, width = np.asarray(knots[:-1], dtype=float), np.diff(knots)
    done: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    scale = None
    for level in range(60):
        values = speed((start[:, None] + width[:, None] * nodes).ravel()).reshape(len(start), -1)
        fitted = values @ analysis.T
        if scale is None:
            scale = float(np.sum(width * fitted[:, 0]))
        tail = np.max(np.abs(fitted[:, -2:]), axis=1)
        accept = (tail <= 1e-15 * np.max(values, axis=1)) | (width * tail <= 2e-17 * scale) | (level == 59)
        done.append((start[accept], width[accept], fitted[accept]))
        start, width = start[~accept], width[~accept] / 2.0
        if not len(start):
            break
        start, width = np.concatenate([start, start + width]), np.concatenate([width, width])
    starts, widths, fits = (np.concatenate([d[i] for d in done]) for i in range(3))
    order = np.argsort(starts)
    starts, widths, fits = starts[order], widths[order], fits[order]
    k = np.arange(0, _DEGREE + 1, 2)
    areas = widths * (fits[:, k] @ (1.0 / (1.0 - k**2)))  # ∫ T_k over [−1, 1] is 2 / (1 − k²) for even k
    ends = np.concatenate([[0.0], np.cumsum(areas)])
    coefficients = (fits @ integrals.T) * widths[:, None] ** (1.0 - np.arange(_DEGREE + 2))
    coefficients[:, 0] = ends[:-1]
    return np.append(starts, knots[-1]), coefficients[:, None, :], float(ends[-1])


# --- sampling and searches --------------------------------------------------------------------------------------------


def _subdivide(knots: np.ndarray) -> np.ndarray:
    """Return the knots with equally many points between each two of them, at least 64 intervals in all."""
    cells = max(4, -(-64 // (len(knots) - 1)))
    parts = [np.linspace(a, b, cells, endpoint=False) for a, b in pairwise(knots)]
    return np.append(np.concatenate(parts), knots[-1])


def grid(path: Curve) -> np.ndarray:
    """Return path parameters whose cells turn by at most 0.05 rad and are at most length/400 long."""
    theta = _subdivide(path.knots)
    for _ in range(14):
        middle = (theta[1:] + theta[:-1]) / 2.0
        ends, mids = path.frame(theta), path.frame(middle)
        curvature = np.max(np.abs([ends.curvature[1:], ends.curvature[:-1], mids.curvature]), axis=0)
        size = np.max([ends.speed[1:], ends.speed[:-1], mids.speed], axis=0) * np.diff(theta)
        coarse = (size * curvature > 0.05) | (size > path.length / 400.0)
        if not coarse.any():
            break
        theta = np.sort(np.concatenate([theta, middle[coarse]]))
    return theta


def invert(path: Curve, s: np.ndarray) -> np.ndarray:
    """Return the parameters at which the arc length is s, within [0, length] (Newton between brackets)."""
    theta, lengths = path.sampling
    i = np.clip(np.searchsorted(lengths, s, side="right") - 1, 0, len(theta) - 2)
    low, high = theta[i], theta[i + 1]
    result: np.ndarray = low + (high - low) * (s - lengths[i]) / (lengths[i + 1] - lengths[i])
    for _ in range(60):
        error = path.arc_length(result) - s
        low, high = np.where(error < 0, result, low), np.where(error > 0, result, high)
        step = result - error / np.hypot(*path.sigma(result, 1))
        step = np.where((step < low) | (step > high), (low + high) / 2.0, step)
        moved, result = np.abs(step - result), step
        if np.all(moved <= 4e-16 * (1.0 + np.abs(result))):
            break
    return result


def as_positions(path: Curve, y: object) -> np.ndarray:
    """Return positions as an array, and refuse other shapes.

    Raises
    ------
    ParameterError
        For another shape than (2,) or (2, N).
    """
    try:
        array = np.asarray(y, dtype=float)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.ndim not in (1, 2) or len(array) != 2:
        raise ParameterError(
            f"found a position of shape {array.shape}; expected (2,), in m, or (2, N) for N of them.",
            block=type(path).__name__,
            port="project",
        )
    return array


def find_nearest(path: Curve, y: np.ndarray) -> float:
    """Return the parameter of the point of the path nearest to y, among all of it.

    Around every dip of the sampled distance that may be the least, three cells to both sides are resampled 16 times as
    finely, twice, since two minima may share a cell near a cusp of the evolute. The dips left are polished by Newton
    steps within their brackets, and the best is returned.
    """
    if not np.all(np.isfinite(y)):
        return float("nan")
    theta, lengths = path.sampling
    squared = np.sum((path.sampled - y[:, None]) ** 2, axis=0)
    bound = (np.sqrt(np.min(squared)) + np.max(np.diff(lengths))) ** 2
    ends = [theta[0], theta[-1]] if path.period is None else []
    if path.period is not None:
        theta = np.concatenate([theta[-4:-1] - path.period, theta, theta[1:4] + path.period])
        squared = np.concatenate([squared[-4:-1], squared, squared[1:4]])
    i = np.flatnonzero(_dips(squared) & (squared <= bound))
    low, high = theta[np.maximum(i - 3, 0)], theta[np.minimum(i + 3, len(theta) - 1)]
    for margin in (3, 1):
        fine = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, 97)
        d = np.sum((path.sigma(fine) - y[:, None, None]) ** 2, axis=0)
        row, column = np.nonzero(_dips(d))
        best = np.argsort(d[row, column], kind="stable")[:_MOST_MINIMA]
        row, column = row[best], column[best]
        low, high = fine[row, np.maximum(column - margin, 0)], fine[row, np.minimum(column + margin, 96)]
    candidates = polish(path, y, low, high)
    for end in ends:
        candidates = np.where(np.abs(candidates - end) <= 1e-15 * (theta[-1] - theta[0]), end, candidates)
    candidates = np.concatenate([ends, candidates])
    distance = np.sum((path.sigma(candidates) - y[:, None]) ** 2, axis=0)
    return float(candidates[np.argmin(distance)])


def _dips(values: np.ndarray) -> np.ndarray:
    """Return a mask of the values that are no larger than their neighbours along the last axis."""
    padded = np.pad(values, [(0, 0)] * (values.ndim - 1) + [(1, 1)], constant_values=np.inf)
    dips: np.ndarray = (values <= padded[..., :-2]) & (values <= padded[..., 2:])
    return dips


def polish(path: Curve, y: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the rising roots of (σ − y)ᵀσ′ between brackets, by Newton steps, or halving if one would leave them."""
    theta: np.ndarray = (low + high) / 2.0
    for _ in range(60):
        s0, s1, s2 = path.derivatives(theta, 2)
        d = s0 - y[:, None]
        slope, curve = np.sum(d * s1, axis=0), np.sum(s1 * s1 + d * s2, axis=0)
        low, high = np.where(slope < 0, theta, low), np.where(slope > 0, theta, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = theta - slope / curve
        step = np.where((curve > 0) & (step >= low) & (step <= high), step, (low + high) / 2.0)
        step = np.where(slope == 0, theta, step)
        moved, theta = np.abs(step - theta), step
        if np.all(moved <= 2e-16 * (1.0 + np.abs(theta))):
            break
    return theta


# --- reach ------------------------------------------------------------------------------------------------------------


class _Contact:
    """Curvature of the circle that touches the path at θ and passes through its point at φ: 2 nᵀΔ/|Δ|²."""

    def __init__(self, path: Curve):
        self.path = path
        self.near = 1e-4 * path.length / np.pi
        theta, _ = path.sampling
        points = path.sampled
        if path.period is not None:  # one more cell at both ends gives every maximum two neighbours
            theta = np.concatenate([[theta[-2] - path.period], theta, [theta[1] + path.period]])
            points = np.concatenate([points[:, -2:-1], points, points[:, 1:2]], axis=1)
        self.phi, self.points = theta, points

    def curvature(self, theta: np.ndarray, phi: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the curvature for θ (M,), φ (M, P) and σ(φ) (2, M, P); near θ its series, κ + κ_s Δs/3."""
        frame = self.path.frame(theta)
        apart = phi - theta[:, None]
        if self.path.period is not None:
            apart = apart - self.path.period * np.round(apart / self.path.period)
        s = frame.speed[:, None] * apart
        d = points - frame.sigma[:, :, None]
        squared = np.sum(d * d, axis=0)
        across = 2.0 * np.sum(frame.normal[:, :, None] * d, axis=0)
        close = np.abs(s) < self.near
        series = frame.curvature[:, None] + frame.curvature_rate[:, None] * s / 3.0
        far = across / np.maximum(squared, np.maximum(np.abs(across) / _CROWDED, 1e-300))
        result: np.ndarray = np.where(close, series, far)
        return result

    def inverse_reach(self, theta: np.ndarray) -> np.ndarray:
        """Return the largest contact curvature at each θ, left and right: shape (M, 2)."""
        return np.concatenate([self._maxima(part) for part in np.array_split(theta, 1 + len(theta) // 256)])

    def _maxima(self, theta: np.ndarray) -> np.ndarray:
        if not len(theta):
            return np.zeros((0, 2))
        points = np.broadcast_to(self.points[:, None, :], (2, len(theta), len(self.phi)))
        table = self.curvature(theta, np.broadcast_to(self.phi, points.shape[1:]), points)
        own = self.path.frame(theta).curvature
        sides = []
        for sign in (1.0, -1.0):
            best = np.maximum(np.max(sign * table, axis=1), sign * own)
            peaks = np.where(
                (sign * table[:, 1:-1] >= sign * table[:, :-2]) & (sign * table[:, 1:-1] >= sign * table[:, 2:]),
                sign * table[:, 1:-1],
                -np.inf,
            )
            for _ in range(2):  # the two highest peaks of the samples, made exact
                column = np.argmax(peaks, axis=1)
                peaks[np.arange(len(theta)), column] = -np.inf
                best = np.maximum(best, self._peak(theta, self.phi[column], self.phi[column + 2], sign))
            sides.append(np.clip(best, 1.0 / UNLIMITED, _CROWDED))
        return np.stack(sides, axis=1)

    def _peak(self, theta: np.ndarray, low: np.ndarray, high: np.ndarray, sign: float) -> np.ndarray:
        """Return the maximum over φ between two brackets (golden section)."""
        golden = (np.sqrt(5.0) - 1.0) / 2.0

        def value(phi: np.ndarray) -> np.ndarray:
            return sign * self.curvature(theta, phi[:, None], self.path.sigma(phi)[:, :, None])[:, 0]

        a, b = high - golden * (high - low), low + golden * (high - low)
        fa, fb = value(a), value(b)
        for _ in range(30):
            left = fa >= fb
            low, high = np.where(left, low, a), np.where(left, b, high)
            new = np.where(left, high - golden * (high - low), low + golden * (high - low))
            f = value(new)
            a, b, fa, fb = np.where(left, new, b), np.where(left, a, new), np.where(left, f, fb), np.where(left, fa, f)
        best: np.ndarray = np.maximum(fa, fb)
        return best


def reach_table(path: Curve) -> tuple[np.ndarray, np.ndarray]:
    """Return breaks and coefficients (pieces, 2, 2) of the inverse reach, left and right, linear between the nodes.

    The inverse reach is a maximum of smooth functions, so at its kinks straight lines lie above it, on the safe side.
    Intervals are cut in three until the line is near enough at both thirds; then the slack is added everywhere.
    """
    contact = _Contact(path)
    flat = 0.15 / path.length  # errors below it don't matter: the reach is then many times the path's size
    theta = _subdivide(path.knots)
    values = contact.inverse_reach(theta)
    open_ = np.ones(len(theta) - 1, dtype=bool)  # intervals still to examine
    for _ in range(8):
        index = np.flatnonzero(open_)
        thirds, exact, bad = [], [], np.zeros(len(index), dtype=bool)
        for part in (1.0 / 3.0, 2.0 / 3.0):
            thirds.append(theta[index] + part * (theta[index + 1] - theta[index]))
            exact.append(contact.inverse_reach(thirds[-1]))
            excess = exact[-1] - (values[index] + part * (values[index + 1] - values[index]))
            scale = np.maximum(exact[-1], flat)
            bad |= np.any((excess > _SLACK * scale) | (excess < -_GENEROUS * scale), axis=1)
        if not bad.any():
            break
        place = np.repeat(index[bad] + 1, 2)
        theta = np.insert(theta, place, np.stack(thirds, axis=1)[bad].ravel())
        values = np.insert(values, place, np.stack(exact, axis=1)[bad].reshape(-1, 2), axis=0)
        first = index[bad] + 2 * np.arange(bad.sum())
        open_ = np.zeros(len(theta) - 1, dtype=bool)
        open_[np.concatenate([first, first + 1, first + 2])] = True
    values = np.where(values > 1.0 / UNLIMITED, values + 2.0 * _SLACK * np.maximum(values, flat), values)
    slope = np.diff(values, axis=0) / np.diff(theta)[:, None]
    return theta, np.stack([values[:-1], slope], axis=2)
