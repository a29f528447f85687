"""The reach of a curve: the distances to both sides up to which its points are the nearest ones, as a table."""

from __future__ import annotations

import math

import numpy as np

from .curve import Curve, subdivide

UNLIMITED = 1e6
"""Reach of a path without a limit, m: a finite number, so that equations can be traced and compared."""
CROWDED = 1e9
"""Largest inverse reach in the table in 1/m, where a path meets itself."""
SLACK = 5e-4
"""Allowed relative error of the inverse reach between two nodes; it is then added to the table."""
GENEROUS = 1e-2
"""The same for an error on the safe side."""


def replace_unlimited(reach: float) -> float:
    """Return the reach, infinite in place of `UNLIMITED`, for messages."""
    return math.inf if reach >= UNLIMITED * (1.0 - 1e-9) else reach


class TouchingCircles:
    """Curvature of the circle that touches the curve at θ and passes through its point at φ: 2 nᵀΔ/|Δ|²."""

    def __init__(self, curve: Curve):
        self.curve = curve
        self.near = 1e-4 * curve.length / np.pi
        theta, _ = curve.sampling
        points = curve.sampled
        if curve.period is not None:  # one more cell at both ends gives every maximum two neighbours
            theta = np.concatenate([[theta[-2] - curve.period], theta, [theta[1] + curve.period]])
            points = np.concatenate([points[:, -2:-1], points, points[:, 1:2]], axis=1)
        self.phi, self.points = theta, points

    def curvature(self, theta: np.ndarray, phi: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the curvature for θ (M,), φ (M, P) and σ(φ) (2, M, P); near θ its series, κ + κ_s Δs/3."""
        frame = self.curve.frame(theta)
        apart = phi - theta[:, None]
        if self.curve.period is not None:
            apart = apart - self.curve.period * np.round(apart / self.curve.period)
        s = frame.speed[:, None] * apart
        d = points - frame.sigma[:, :, None]
        squared = np.sum(d * d, axis=0)
        across = 2.0 * np.sum(frame.normal[:, :, None] * d, axis=0)
        close = np.abs(s) < self.near
        series = frame.curvature[:, None] + frame.curvature_rate[:, None] * s / 3.0
        far = across / np.maximum(squared, np.maximum(np.abs(across) / CROWDED, 1e-300))
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
        own = self.curve.frame(theta).curvature
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
            sides.append(np.clip(best, 1.0 / UNLIMITED, CROWDED))
        return np.stack(sides, axis=1)

    def _peak(self, theta: np.ndarray, low: np.ndarray, high: np.ndarray, sign: float) -> np.ndarray:
        """Return the maximum over φ between two brackets (golden section)."""
        golden = (np.sqrt(5.0) - 1.0) / 2.0

        def value(phi: np.ndarray) -> np.ndarray:
            return sign * self.curvature(theta, phi[:, None], self.curve.sigma(phi)[:, :, None])[:, 0]

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


def reach_table(curve: Curve) -> tuple[np.ndarray, np.ndarray]:
    """Return breaks and coefficients (pieces, 2, 2) of the inverse reach, left and right, linear between the nodes."""
    # The inverse reach is a maximum of smooth functions, so at its kinks straight lines lie above it, on the safe side.
    # Intervals are cut in three until the line is near enough at both thirds; then the slack is added everywhere.
    circles = TouchingCircles(curve)
    flat = 0.15 / curve.length  # errors below it don't matter: the reach is then many times the path's size
    theta = subdivide(curve.knots)
    values = circles.inverse_reach(theta)
    open_ = np.ones(len(theta) - 1, dtype=bool)  # intervals still to examine
    for _ in range(8):
        index = np.flatnonzero(open_)
        thirds, exact, bad = [], [], np.zeros(len(index), dtype=bool)
        for part in (1.0 / 3.0, 2.0 / 3.0):
            thirds.append(theta[index] + part * (theta[index + 1] - theta[index]))
            exact.append(circles.inverse_reach(thirds[-1]))
            excess = exact[-1] - (values[index] + part * (values[index + 1] - values[index]))
            scale = np.maximum(exact[-1], flat)
            bad |= np.any((excess > SLACK * scale) | (excess < -GENEROUS * scale), axis=1)
        if not bad.any():
            break
        place = np.repeat(index[bad] + 1, 2)
        theta = np.insert(theta, place, np.stack(thirds, axis=1)[bad].ravel())
        values = np.insert(values, place, np.stack(exact, axis=1)[bad].reshape(-1, 2), axis=0)
        first = index[bad] + 2 * np.arange(bad.sum())
        open_ = np.zeros(len(theta) - 1, dtype=bool)
        open_[np.concatenate([first, first + 1, first + 2])] = True
    values = np.where(values > 1.0 / UNLIMITED, values + 2.0 * SLACK * np.maximum(values, flat), values)
    slope = np.diff(values, axis=0) / np.diff(theta)[:, None]
    return theta, np.stack([values[:-1], slope], axis=2)
