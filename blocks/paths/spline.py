"""Cubic splines as paths."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ..core import Array, ParameterError, parameter
from ..library import jet, wrap
from .curve import check_order
from .path import Path

__all__ = ["CubicSpline"]


class CubicSpline(Path):
    """Cubic spline σ(θ) through points, twice continuously differentiable, closed or open.

    σ(θ) = Σⱼ cᵢⱼ (θ − θᵢ)ʲ, j = 0 … 3, between the points i and i + 1.

    The parameter θ is the accumulated distance of the points (chord length, m), 0 at the first. A closed spline goes
    from the last point back to the first. An open one is natural (σ″ = 0 at its ends) and continues straight beyond
    them.

    κ is continuous and κ_s jumps at the points, so the motor force (10) of a robot that moves off the path jumps
    there.

    Raises
    ------
    ParameterError
        For too few points, points that coincide, and a curve with a cusp, where σ′ vanishes (E19).
    """

    points: Array = parameter(unit="m", description="the points (y, z) it passes through, shape (N, 2)")
    closed: bool = parameter(default=False, description="True to return to the first point")

    def check(self) -> None:
        """Refuse too few points, points that coincide, and a curve whose speed vanishes."""
        points, least = np.asarray(self.points), 3 if self.closed else 2
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < least:
            raise ParameterError(
                f"found an array of shape {np.shape(points)}; expected (N, 2) with at least {least} points for "
                f"{'a closed' if self.closed else 'an open'} spline. Give one row (y, z) for each point.",
                port="points",
            )
        chords = self._chords()
        scale = float(np.max(np.ptp(points, axis=0)))
        for i in np.flatnonzero(chords <= 1e-12 * scale):
            j = (i + 1) % len(points)
            step = "Leave the last one out; a closed spline returns by itself." if j == 0 else "Leave one of them out."
            raise ParameterError(
                f"points {i} and {j} are both {points[i].tolist()}; expected consecutive points to differ. {step}",
                port="points",
            )
        slowest, theta = self._find_slowest()
        if slowest < 1e-6:  # chord length makes the speed about 1
            raise ParameterError(
                f"the spline's speed falls to {slowest:.3g} at theta = {theta:.6g} m, where it has a cusp or turns "
                "back; expected a smooth curve. Move the points there, or add some.",
                port="points",
            )

    def _chords(self) -> np.ndarray:
        points = np.vstack([self.points, self.points[:1]]) if self.closed else self.points
        chords: np.ndarray = np.hypot(*np.diff(points, axis=0).T)
        return chords

    @cached_property
    def _cubics(self) -> tuple[np.ndarray, np.ndarray]:
        """Breaks and coefficients (pieces, 2, 4), including an open spline's straight continuations."""
        from scipy.interpolate import CubicSpline as Interpolant  # imported late, since it takes long

        breaks = np.concatenate([[0.0], np.cumsum(self._chords())])
        points = np.vstack([self.points, self.points[:1]]) if self.closed else self.points
        pieces = Interpolant(breaks, points, bc_type="periodic" if self.closed else "natural").c
        coefficients = np.ascontiguousarray(pieces[::-1].transpose(1, 2, 0))
        if not self.closed:
            span, last = breaks[-1], coefficients[-1]
            h = breaks[-1] - breaks[-2]
            first, slope = coefficients[0, :, 1], last @ [0.0, 1.0, 2.0 * h, 3.0 * h * h]
            ends = np.zeros((2, 2, 4))
            ends[0, :, 0], ends[0, :, 1] = points[0] - span * first, first
            ends[1, :, 0], ends[1, :, 1] = points[-1], slope
            breaks = np.concatenate([[-span], breaks, [2.0 * span]])
            coefficients = np.concatenate([ends[:1], coefficients, ends[1:]])
        return breaks, coefficients

    def _find_slowest(self) -> tuple[float, float]:
        """Return the least speed and its parameter, from the roots of the derivative of its square in every piece."""
        breaks, coefficients = self._cubics
        least, where = np.inf, 0.0
        for start, h, c in zip(breaks, np.diff(breaks), coefficients, strict=False):
            rate = c[:, 1:] * [1.0, 2.0, 3.0]
            slope = np.sum([np.convolve(r, r[1:] * [1.0, 2.0]) for r in rate], axis=0)
            roots = np.roots(slope[::-1]) if np.any(slope) else np.zeros(0)
            near = roots.real[(roots.real > 0) & (roots.real < h)]
            u = np.concatenate([[0.0, h], near])
            speed = np.hypot(*(rate @ np.stack([u**0, u, u * u])))
            if speed.min() < least:
                least, where = float(speed.min()), float(start + u[speed.argmin()])
        return least, where

    @property
    def period(self) -> float | None:
        """Sum of the distances of the points, m; None for an open spline."""
        return float(self._cubics[0][-1]) if self.closed else None

    @property
    def domain(self) -> tuple[float, float] | None:
        """0 and the sum of the distances of the points, m; None for a closed spline."""
        return None if self.closed else (0.0, float(self._cubics[0][-2]))

    @property
    def knots(self) -> np.ndarray:
        """Parameters of the points; a closed spline's first point is also the last."""
        return self._cubics[0] if self.closed else self._cubics[0][1:-1]

    def sigma(self, theta: Array, order: int = 0) -> Array:
        """Return the point σ(θ), m, or its derivative of the given order (0 to 3)."""
        return self.derivatives(theta, check_order(self, order))[order]

    def derivatives(self, theta: Array, highest: int = 3) -> tuple[Array, ...]:
        """Return σ(θ) and its derivatives up to the order ``highest``, from one lookup."""
        breaks, coefficients = self._cubics
        if self.closed:
            theta = wrap(theta, 0.0, float(breaks[-1]))[1]
        return jet(breaks, coefficients, theta, highest)
