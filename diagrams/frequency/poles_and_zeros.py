"""Poles and zeros of a loop; those on the limit of stability gathered, and apart from the others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from control import StateSpace

SIDES = np.array([-10, -3, -1, -0.3, 0.0, 0.3, 1, 3, 10])
"""Distances from a pole or zero, in parts of its distance from the axis, at which a scan has frequencies."""
GAP = 2e-9
"""Relative distance that a scan keeps from a single pole or zero on the axis."""


class PolePlane:
    """The plane of a system's poles p: that of s, or of z − 1 where it is sampled.

    The shift keeps poles accurate far below the sampling frequency. Points s lie at p = exp(s T) − 1.
    """

    dt: float

    @property
    def nyquist(self) -> float:
        """Highest frequency of the response in rad/s: π/T, or infinity."""
        return np.pi / self.dt if self.dt else np.inf

    def point(self, s: np.ndarray) -> np.ndarray:
        """Return p at points s."""
        return np.asarray(np.expm1(s * self.dt) if self.dt else s, dtype=complex)

    def logarithm(self, p: np.ndarray) -> np.ndarray:
        """Return s at points p; −∞ for z = 0."""
        p = np.asarray(p, dtype=complex)
        if not self.dt:
            return p
        with np.errstate(divide="ignore", invalid="ignore"):
            # log|1 + p| without cancellation near p = 0
            real = 0.5 * np.log1p(np.maximum(2 * p.real + np.abs(p) ** 2, -1.0))
            return np.asarray((real + 1j * np.angle(1 + p)) / self.dt)

    def growth(self, p: np.ndarray) -> np.ndarray:
        """Return the distance of poles beyond the limit of stability: Re s, or |z| − 1."""
        if not self.dt:
            return np.asarray(np.real(p))
        square = 2 * np.real(p) + np.abs(p) ** 2
        return np.asarray(square / (1 + np.sqrt(1 + square)))


@dataclass(frozen=True)
class AxisPole:
    """Coinciding poles, or zeros, on the limit of stability, at a frequency in rad/s from 0 on."""

    omega: float
    multiplicity: int
    scatter: float
    """Largest distance of a computed eigenvalue from their mean, rad/s."""

    @property
    def gap(self) -> float:
        """Relative distance that a scan keeps from them where they are not at s = 0.

        The matrix s I − A of m coinciding poles is singular but for rounding within ε^(1/m) of them.
        """
        if self.multiplicity == 1:
            return GAP
        return max(GAP, 30.0 * self.scatter / self.omega, 3.0 * float(1e-15 ** (1.0 / self.multiplicity)))


@dataclass(frozen=True, eq=False)
class Features:
    """Poles and zeros of a loop in the s plane, those on the axis gathered and apart from the others."""

    axis_poles: tuple[AxisPole, ...]
    poles: np.ndarray
    axis_zeros: tuple[AxisPole, ...]
    zeros: np.ndarray
    closed: np.ndarray

    def unstable_poles(self) -> int:
        """Return the number of open-loop poles beyond the limit of stability; those on it are not counted."""
        return int(np.sum(self.poles.real > 0))

    def sizes(self) -> np.ndarray:
        """Return the magnitudes of all poles and zeros that are not at s = 0, sorted, rad/s."""
        points = [np.abs(self.poles), np.abs(self.zeros), np.abs(self.closed)]
        on_axis = [a.omega for a in (*self.axis_poles, *self.axis_zeros)]
        sizes = np.concatenate([*points, on_axis])
        sizes = np.sort(sizes[sizes > 0])
        floor = 1e-12 * sizes[-1] if len(sizes) else 0.0
        return sizes[sizes > floor]

    def points(self) -> np.ndarray:
        """Return all poles and zeros off the axis: the response bends near them."""
        return np.concatenate([self.poles, self.zeros, self.closed])


def split_axis_poles(
    plane: PolePlane, p: np.ndarray, scale: float, errors: np.ndarray | None = None
) -> tuple[tuple[AxisPole, ...], np.ndarray]:
    """Split poles into those on the limit of stability, with coinciding ones gathered, and the others, all as s.

    m coinciding poles are computed with a scatter of ε^(1/m), ε the rounding; their mean is accurate to ε. Where the
    errors of the poles are known, each may be as far from the mean, since others may lie around a mean on the limit.
    """
    left, found = list(np.asarray(p, dtype=complex)), []
    allowed = [np.inf] * len(left) if errors is None else list(errors)
    for m in range(min(len(left), 8), 0, -1):
        radius = 10 * scale * 1e-15 ** (1 / m)
        again = True
        while again and len(left) >= m:
            again = False
            for middle in left:
                near = sorted(range(len(left)), key=lambda k: abs(left[k] - middle))[:m]
                group = np.array([left[k] for k in near])
                mean = complex(group.mean())
                spread = float(np.max(np.abs(group - mean)))
                explained = all(abs(left[k] - mean) <= allowed[k] for k in near)
                if spread <= radius and explained and abs(float(plane.growth(np.array(mean)))) <= 1e-11 * scale:
                    left, allowed = ([v for k, v in enumerate(of) if k not in near] for of in (left, allowed))
                    found.append((mean, m, spread))
                    again = True
                    break
    axis = []
    for mean, m, spread in found:
        s = complex(plane.logarithm(np.array(mean)))
        omega = abs(s.imag)
        rate = 1 / plane.dt if plane.dt else 1.0
        if omega <= 1e-9 * scale * rate + 3 * spread * rate:
            omega = 0.0
        if plane.dt and abs(omega - plane.nyquist) <= 1e-9 * plane.nyquist:
            omega = plane.nyquist
        if s.imag >= 0 or omega in (0.0, plane.nyquist):
            axis.append(AxisPole(omega, m, max(spread, 1e-15 * scale) * rate))
    rest = plane.logarithm(np.array(left, dtype=complex))
    return tuple(sorted(axis, key=lambda a: a.omega)), rest[np.isfinite(rest)]


def transmission_zeros(A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray) -> np.ndarray:
    """Return the zeros of a loop with one channel, in the plane of p.

    Zeros at infinity scatter by rounding to some 1e15^(1/k) times the poles, k of them together. How many of them there
    are is read from the Markov parameters, not from where they were found.
    """
    from scipy.linalg import eig

    n = len(A)
    if not n or len(D) != 1 or not (finite := n - count_zeros_at_infinity(A, B, C, D)):
        return np.zeros(0)
    b, c = np.linalg.norm(B) or 1.0, np.linalg.norm(C) or 1.0
    pencil = np.block([[A, B / b], [C / c, D / (b * c)]])
    alpha, beta = eig(pencil, np.diag([1.0] * n + [0.0]), right=False, homogeneous_eigvals=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        zeros = alpha / beta
    zeros = zeros[np.isfinite(zeros)]
    zeros = zeros[np.argsort(np.abs(zeros), kind="stable")[:finite]]
    return np.asarray(zeros[np.abs(zeros) < 1e6 * max(float(np.linalg.norm(A)), 1e-300)])


def count_zeros_at_infinity(A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray) -> int:
    """Return the relative degree of a loop with one channel: the place of the first Markov parameter D, CB, CAB, … ≠ 0.

    A sum of products is 0 where it is less than its rounding, which follows the sizes of the products.
    """
    order, row, x, size = len(A), C[0], B[:, 0], np.abs(B[:, 0])
    if D[0, 0]:  # what rounding left in it was removed with the reduction
        return 0
    for k in range(1, order):
        if abs(row @ x) > 1e-15 * (order + k) * (np.abs(row) @ size):
            return k
        x, size = A @ x, np.abs(A) @ size
    return order


def finite_zeros(system: StateSpace) -> np.ndarray:
    """Return the zeros of a system with as many inputs as outputs, without those that rounding scatters from infinity.

    The number of those at infinity is the relative degree of det G: with one channel by its Markov parameters, with
    several by the slope of det G over far real frequencies. Where that slope is no whole number, zeros beyond 1e6 times
    the size of A are left out.
    """
    zeros = np.asarray(np.ravel(system.zeros()), dtype=complex)
    zeros = zeros[np.argsort(np.abs(zeros), kind="stable")]
    A, B, C, D = (np.asarray(matrix, dtype=float) for matrix in (system.A, system.B, system.C, system.D))
    if len(D) == 1:
        return np.asarray(zeros[: max(len(A) - count_zeros_at_infinity(A, B, C, D), 0)])
    far = 1e3 * (float(np.linalg.norm(A, 2)) if A.any() else 1.0)
    near, beyond = (abs(np.linalg.det(C @ np.linalg.solve(s * np.eye(len(A)) - A, B) + D)) for s in (far, 4.0 * far))
    if not near or not beyond:
        return np.zeros(0)  # G has no inverse: every number would be a zero
    degree = float(np.log(near / beyond) / np.log(4.0))
    if abs(degree - round(degree)) < 0.05:  # poles and zeros of the size of A bend the slope by some 1e-3 each
        return np.asarray(zeros[: max(len(A) - round(degree), 0)])
    return np.asarray(zeros[np.abs(zeros) < 1e3 * far])
