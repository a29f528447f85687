"""Paths in closed form: ellipse, circle, line."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ..core import Array, ParameterError, parameter
from .curve import check_order
from .path import Path, as_positions
from .reach import UNLIMITED

__all__ = ["Circle", "Ellipse", "Line"]

_MOST_TERMS = 128  # of the ellipse's Fourier series; a table replaces a longer one (axis ratio above about 7)


def _turn(theta: Array, order: int) -> tuple[Array, Array]:
    """Return the derivatives of cos θ and sin θ of the given order."""
    c, s = np.cos(theta), np.sin(theta)
    return ((c, s), (-s, c), (-c, -s), (s, -c))[order]


class Ellipse(Path):
    """Ellipse σ(θ) = c + (a cos θ, ± b sin θ), counter-clockwise (+) or clockwise (−), period 2π; equation (16).

    a and b are the semi-axes (E12). The normal points inwards if the direction is counter-clockwise (ξ > 0 is inside),
    else outwards. The reach inwards is that of docs/explanation/paper.md, b²/a at the ends of the major axis.

    Raises
    ------
    ParameterError
        For semi-axes that are not positive.
    """

    semi_axes: Array = parameter(unit="m", above=0.0, shape=(2,), description="semi-axes a along y and b along z")
    center: Array = parameter(default=np.zeros(2), unit="m", shape=(2,), description="the centre (y, z)")
    clockwise: bool = parameter(default=False, description="True for the clockwise direction")

    @property
    def period(self) -> float:
        """2π."""
        return 2.0 * np.pi

    @property
    def knots(self) -> np.ndarray:
        """Parameters of the ends of the semi-axes."""
        return np.linspace(0.0, 2.0 * np.pi, 5)

    @property
    def _axes(self) -> tuple[float, float]:
        return float(self.semi_axes[0]), float(self.semi_axes[1]) * (-1.0 if self.clockwise else 1.0)

    def sigma(self, theta: Array, order: int = 0) -> Array:
        """Return c + (a cos θ, ± b sin θ), m, or its derivative of the given order (0 to 3)."""
        a, b = self._axes
        c, s = _turn(theta, check_order(self, order))
        if order:
            return np.stack([a * c, b * s])
        return np.stack([self.center[0] + a * c, self.center[1] + b * s])

    @cached_property
    def _fourier(self) -> np.ndarray | None:
        """Mean speed, then the coefficients of sin 2kθ in the arc length; None if there would be too many."""
        # The speed has the period π; its Fourier coefficients fall like ((a − b)/(a + b))^k, so that the trapezoidal
        # rule (a DFT) gives them to rounding errors.
        a, b = self.semi_axes
        n = 8 * _MOST_TERMS
        theta = np.pi / n * np.arange(n)
        c = np.fft.rfft(np.sqrt((a * np.sin(theta)) ** 2 + (b * np.cos(theta)) ** 2)).real / n
        sines = c[1:] / np.arange(1, len(c))  # 2 c_k / (2 k)
        small = np.flatnonzero(np.abs(sines) < 1e-17 * c[0])
        if not len(small) or small[0] > _MOST_TERMS:
            return None
        return np.concatenate([c[:1], sines[: small[0]]])

    @property
    def length(self) -> float:
        """Length of the whole ellipse, m: 4 a E(1 − b²/a²)."""
        return super().length if self._fourier is None else float(2.0 * np.pi * self._fourier[0])

    def arc_length(self, theta: Array) -> Array:
        """Return the arc length η₁ = g(θ) from θ = 0, equation (5), m; laps count.

        g is the mean speed times θ plus a sine series, summed by Clenshaw's rule. Extreme axis ratios use a table.
        """
        if self._fourier is None:
            return super().arc_length(theta)
        mean, *sines = self._fourier.tolist()
        twice = 2.0 * np.cos(2.0 * theta)
        b1, b2 = 0.0 * twice, 0.0 * twice
        for c in reversed(sines):
            b1, b2 = c + twice * b1 - b2, b1
        return mean * theta + np.sin(2.0 * theta) * b1

    def reach(self, theta: Array) -> tuple[Array, Array]:
        """Return the reach to the left and to the right, m: inwards m‖σ′‖/M (m the smaller, M the larger semi-axis).

        The reach ends at the medial axis, a segment of the larger axis; outwards there is no limit (`UNLIMITED`).
        """
        s1 = self.sigma(theta, 1)
        ratio = float(np.min(self.semi_axes) / np.max(self.semi_axes))
        inward = ratio * np.sqrt(s1[0] * s1[0] + s1[1] * s1[1])
        outward = UNLIMITED + 0.0 * inward
        return (outward, inward) if self.clockwise else (inward, outward)

    def project(self, y: Array) -> Array:
        """Return the parameter of the nearest point, equation (4); NumPy only.

        It lies in the quadrant of y, and (σ − y)ᵀσ′ has one sign change there, so that Newton's method between brackets
        finds it. On the medial axis, where two points are equally near, it is that with positive sin θ (or cos θ).
        """
        a, b = self.semi_axes
        y = as_positions(self, y)
        u, v = y[0] - self.center[0], y[1] - self.center[1]
        if self.clockwise:
            v = -v
        p, q = np.abs(u), np.abs(v)
        low, high = np.zeros(np.shape(u)), np.full(np.shape(u), np.pi / 2.0)
        theta = np.clip(np.arctan2(a * q, b * p), 1e-3, 1.57)  # not on the axes: y on an axis makes that a root
        for _ in range(80):
            c, s = np.cos(theta), np.sin(theta)
            slope = (b * b - a * a) * s * c + a * p * s - b * q * c
            curve = (b * b - a * a) * (c * c - s * s) + a * p * c + b * q * s
            low, high = np.where(slope < 0, theta, low), np.where(slope < 0, high, theta)
            step = theta - slope / np.where(curve > 0, curve, 1.0)
            step = np.where((curve > 0) & (step > low) & (step < high), step, (low + high) / 2.0)
            moved, theta = np.abs(step - theta), step
            if np.all(moved <= 1e-16):
                break
        angle = np.where(u < 0, np.pi - theta, theta)
        angle = self._wrap(np.where(v < 0, -angle, angle))
        return angle if angle.ndim else float(angle)


class Circle(Path):
    """Circle σ(θ) = c + r (cos θ, ± sin θ), counter-clockwise (+) or clockwise (−), period 2π: (16) with a = b.

    Raises
    ------
    ParameterError
        For a radius that is not positive.
    """

    radius: float = parameter(unit="m", above=0.0, description="radius r")
    center: Array = parameter(default=np.zeros(2), unit="m", shape=(2,), description="the centre (y, z)")
    clockwise: bool = parameter(default=False, description="True for the clockwise direction")

    @property
    def period(self) -> float:
        """2π."""
        return 2.0 * np.pi

    def sigma(self, theta: Array, order: int = 0) -> Array:
        """Return c + r (cos θ, ± sin θ), m, or its derivative of the given order (0 to 3)."""
        r, turn = self.radius, -1.0 if self.clockwise else 1.0
        c, s = _turn(theta, check_order(self, order))
        if order:
            return np.stack([r * c, turn * r * s])
        return np.stack([self.center[0] + r * c, self.center[1] + turn * r * s])

    @property
    def length(self) -> float:
        """Circumference 2π r, m."""
        return 2.0 * np.pi * self.radius

    def arc_length(self, theta: Array) -> Array:
        """Return the arc length η₁ = r θ, equation (5), m; laps count."""
        return self.radius * theta

    def parameter_at(self, s: Array) -> Array:
        """Return θ = s/r."""
        return s / self.radius

    def reach(self, theta: Array) -> tuple[Array, Array]:
        """Return the reach to the left and to the right, m: r inwards, `UNLIMITED` outwards."""
        inward, outward = self.radius + 0.0 * theta, UNLIMITED + 0.0 * theta
        return (outward, inward) if self.clockwise else (inward, outward)

    def project(self, y: Array) -> Array:
        """Return the parameter of the nearest point, equation (4) (0 for the centre); NumPy only."""
        y = as_positions(self, y)
        v = y[1] - self.center[1]
        theta = self._wrap(np.arctan2(-v if self.clockwise else v, y[0] - self.center[0]))
        return theta if theta.ndim else float(theta)


class Line(Path):
    """Straight line σ(θ) = p₀ + θ (p₁ − p₀), θ from 0 to 1; it continues straight beyond its ends.

    Its κ is zero and its reach unlimited, so that path following is that of two Cartesian axes, turned.

    Raises
    ------
    ParameterError
        For a start and an end in the same place.
    """

    start: Array = parameter(unit="m", shape=(2,), description="the start (y, z)")
    end: Array = parameter(unit="m", shape=(2,), description="the end (y, z)")

    def check(self) -> None:
        """Refuse two ends in the same place."""
        if np.array_equal(self.start, self.end):
            raise ParameterError(
                f"found start and end both at {self.start.tolist()}; expected two different points. Move one of them.",
                port="end",
            )

    @property
    def domain(self) -> tuple[float, float]:
        """(0, 1)."""
        return 0.0, 1.0

    def sigma(self, theta: Array, order: int = 0) -> Array:
        """Return p₀ + θ (p₁ − p₀), m, or its derivative of the given order (0 to 3)."""
        d = self.end - self.start
        if check_order(self, order) == 0:
            return np.stack([self.start[0] + d[0] * theta, self.start[1] + d[1] * theta])
        if order == 1:
            return np.stack([d[0] + 0.0 * theta, d[1] + 0.0 * theta])
        return np.stack([0.0 * theta, 0.0 * theta])

    @property
    def length(self) -> float:
        """Distance of the two ends, m."""
        return float(np.hypot(*(self.end - self.start)))

    def arc_length(self, theta: Array) -> Array:
        """Return the arc length η₁ = ‖p₁ − p₀‖ θ, equation (5), m."""
        return self.length * theta

    def parameter_at(self, s: Array) -> Array:
        """Return θ = s/‖p₁ − p₀‖."""
        return s / self.length

    def reach(self, theta: Array) -> tuple[Array, Array]:
        """Return the reach to the left and to the right, m: no limit (`UNLIMITED`)."""
        return UNLIMITED + 0.0 * theta, UNLIMITED + 0.0 * theta

    def project(self, y: Array) -> Array:
        """Return the parameter of the nearest point between the ends, equation (4); NumPy only."""
        y, d = as_positions(self, y), self.end - self.start
        theta = np.clip(((y[0] - self.start[0]) * d[0] + (y[1] - self.start[1]) * d[1]) / (d @ d), 0.0, 1.0)
        return theta if theta.ndim else float(theta)
