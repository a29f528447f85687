"""The nearest point of a curve: the global search behind equation (4)."""

from __future__ import annotations

import numpy as np

from .curve import Curve

MOST_MINIMA = 256
"""Minima of a sampled distance that are followed; more of them are rounding errors, as at the centre of an arc."""


def find_nearest(curve: Curve, y: np.ndarray) -> float:
    """Return the parameter of the point of a curve nearest to y, among all of it."""
    # Around every dip of the sampled distance that may be the least, three cells to both sides are resampled 16 times
    # as finely, twice, since two minima may share a cell near a cusp of the evolute. The dips left are polished by
    # Newton steps within their brackets, and the best is returned.
    if not np.all(np.isfinite(y)):
        return float("nan")
    theta, lengths = curve.sampling
    squared = np.sum((curve.sampled - y[:, None]) ** 2, axis=0)
    bound = (np.sqrt(np.min(squared)) + np.max(np.diff(lengths))) ** 2
    ends = [theta[0], theta[-1]] if curve.period is None else []
    if curve.period is not None:
        theta = np.concatenate([theta[-4:-1] - curve.period, theta, theta[1:4] + curve.period])
        squared = np.concatenate([squared[-4:-1], squared, squared[1:4]])
    i = np.flatnonzero(_dips(squared) & (squared <= bound))
    low, high = theta[np.maximum(i - 3, 0)], theta[np.minimum(i + 3, len(theta) - 1)]
    for margin in (3, 1):
        fine = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, 97)
        d = np.sum((curve.sigma(fine) - y[:, None, None]) ** 2, axis=0)
        row, column = np.nonzero(_dips(d))
        best = np.argsort(d[row, column], kind="stable")[:MOST_MINIMA]
        row, column = row[best], column[best]
        low, high = fine[row, np.maximum(column - margin, 0)], fine[row, np.minimum(column + margin, 96)]
    candidates = _polish(curve, y, low, high)
    for end in ends:
        candidates = np.where(np.abs(candidates - end) <= 1e-15 * (theta[-1] - theta[0]), end, candidates)
    candidates = np.concatenate([ends, candidates])
    distance = np.sum((curve.sigma(candidates) - y[:, None]) ** 2, axis=0)
    return float(candidates[np.argmin(distance)])


def _dips(values: np.ndarray) -> np.ndarray:
    """Return a mask of the values that are no larger than their neighbours along the last axis."""
    padded = np.pad(values, [(0, 0)] * (values.ndim - 1) + [(1, 1)], constant_values=np.inf)
    dips: np.ndarray = (values <= padded[..., :-2]) & (values <= padded[..., 2:])
    return dips


def _polish(curve: Curve, y: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the rising roots of (σ − y)ᵀσ′ between brackets, by Newton steps, or halving if one would leave them."""
    theta: np.ndarray = (low + high) / 2.0
    for _ in range(60):
        s0, s1, s2 = curve.derivatives(theta, 2)
        d = s0 - y[:, None]
        slope, bend = np.sum(d * s1, axis=0), np.sum(s1 * s1 + d * s2, axis=0)
        low, high = np.where(slope < 0, theta, low), np.where(slope > 0, theta, high)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = theta - slope / bend
        step = np.where((bend > 0) & (step >= low) & (step <= high), step, (low + high) / 2.0)
        step = np.where(slope == 0, theta, step)
        moved, theta = np.abs(step - theta), step
        if np.all(moved <= 2e-16 * (1.0 + np.abs(theta))):
            break
    return theta
