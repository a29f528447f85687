"""Poles and zeros of a loop, and a grid of frequencies that resolves all of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .realization import Realization

PER_DECADE = 40
SIDES = np.array([-10, -3, -1, -0.3, 0.0, 0.3, 1, 3, 10])
GAP = 2e-9  # relative distance that a scan keeps from a pole or zero on the axis


@dataclass(frozen=True)
class AxisPole:
    """A pole, or a zero, on the limit of stability.

    Parameters
    ----------
    omega : float
        Frequency, rad/s, not negative.
    multiplicity : int
        Number of coinciding poles.
    scatter : float
        Largest distance of a computed eigenvalue from their mean, rad/s.
    """

    omega: float
    multiplicity: int
    scatter: float


@dataclass(frozen=True, eq=False)
class Features:
    """Poles and zeros of a loop in the s plane, those on the axis gathered and apart from the others.

    ``closed`` are the closed-loop poles.
    """

    axis_poles: tuple[AxisPole, ...]
    poles: np.ndarray
    axis_zeros: tuple[AxisPole, ...]
    zeros: np.ndarray
    closed: np.ndarray

    @classmethod
    def of(cls, r: Realization) -> Features:
        """Return the features of a loop, found by eigenvalues."""
        axis_poles, poles = split_axis_poles(r, np.linalg.eigvals(r.A), r.scale)
        zeros = transmission_zeros(r)
        axis_zeros, zeros = split_axis_poles(r, zeros, max(r.scale, float(np.abs(zeros).max(initial=0.0))))
        try:
            closed = r.logarithm(r.eigenvalues())
        except np.linalg.LinAlgError:
            closed = np.zeros(0)
        return cls(axis_poles, poles, axis_zeros, zeros, closed[np.isfinite(closed)])

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


def split_axis_poles(r: Realization, p: np.ndarray, scale: float) -> tuple[tuple[AxisPole, ...], np.ndarray]:
    """Split poles into those on the limit of stability, with coinciding ones gathered, and the others, all as s.

    m coinciding poles are computed with a scatter of ε^(1/m), ε the rounding; their mean is accurate to ε.
    """
    left, found = list(np.asarray(p, dtype=complex)), []
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
                if spread <= radius and abs(float(r.growth(np.array(mean)))) <= 1e-11 * scale:
                    left = [value for k, value in enumerate(left) if k not in near]
                    found.append((mean, m, spread))
                    again = True
                    break
    axis = []
    for mean, m, spread in found:
        s = complex(r.logarithm(np.array(mean)))
        omega = abs(s.imag)
        rate = 1 / r.dt if r.dt else 1.0
        if omega <= 1e-9 * scale * rate + 3 * spread * rate:
            omega = 0.0
        if r.dt and abs(omega - r.nyquist) <= 1e-9 * r.nyquist:
            omega = r.nyquist
        if s.imag >= 0 or omega in (0.0, r.nyquist):
            axis.append(AxisPole(omega, m, max(spread, 1e-15 * scale) * rate))
    rest = r.logarithm(np.array(left, dtype=complex))
    return tuple(sorted(axis, key=lambda a: a.omega)), rest[np.isfinite(rest)]


def transmission_zeros(r: Realization) -> np.ndarray:
    """Return the zeros of a loop with one channel, in the plane of p.

    Zeros at infinity scatter by rounding to some 1e15^(1/k) times the poles, k of them together. How many of them there
    are is read from the Markov parameters, not from where they were found.
    """
    from scipy.linalg import eig

    n = r.order
    if not n or len(r.D) != 1 or not (finite := n - count_zeros_at_infinity(r)):
        return np.zeros(0)
    b, c = np.linalg.norm(r.B) or 1.0, np.linalg.norm(r.C) or 1.0
    pencil = np.block([[r.A, r.B / b], [r.C / c, r.D / (b * c)]])
    alpha, beta = eig(pencil, np.diag([1.0] * n + [0.0]), right=False, homogeneous_eigvals=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        zeros = alpha / beta
    zeros = zeros[np.isfinite(zeros)]
    zeros = zeros[np.argsort(np.abs(zeros), kind="stable")[:finite]]
    return np.asarray(zeros[np.abs(zeros) < 1e6 * max(r.scale, 1e-300)])


def count_zeros_at_infinity(r: Realization) -> int:
    """Return the relative degree of a loop with one channel: the place of the first Markov parameter D, CB, CAB, … ≠ 0.

    A sum of products is 0 where it is less than its rounding, which follows the sizes of the products.
    """
    C, x, size = r.C[0], r.B[:, 0], np.abs(r.B[:, 0])
    if r.D[0, 0]:  # what rounding left in it was removed with the reduction
        return 0
    for k in range(1, r.order):
        if abs(C @ x) > 1e-15 * (r.order + k) * (np.abs(C) @ size):
            return k
        x, size = r.A @ x, np.abs(r.A) @ size
    return r.order


def scan(r: Realization, features: Features, *, delay: float = 0.0) -> list[np.ndarray]:
    """Return segments of frequencies in rad/s that resolve every pole and zero, cut at those on the axis.

    The grid has 40 points a decade, and more around each pole and zero in proportion to its distance from the axis. It
    is then bisected until the response L e^(−jω delay) turns by less than 0.15 rad and changes by less than 0.3 in its
    logarithm from one point to the next.
    """
    sizes = features.sizes()
    low, high = (sizes[0] / 1e4, sizes[-1] * 1e4) if len(sizes) else (1e-3, 1e3)
    if r.dt:
        high = r.nyquist
    low = min(low, high / 10)
    on_axis = (*features.axis_poles, *features.axis_zeros)
    low = max([low, *(30 * a.scatter for a in on_axis if a.omega == 0.0)])
    low = min(low, high / 10)
    grid = [np.geomspace(low, high, max(2, int(PER_DECADE * np.log10(high / low))))]
    for s in features.points():
        grid.append(abs(s.imag) + abs(s.real) * SIDES)
        grid.append(abs(s) * (1 + 0.1 * np.arange(-3, 4)))
    close = 10.0 ** np.arange(-8, 0)
    grid.extend(a.omega * (1 + np.concatenate([-close, close])) for a in on_axis)
    omega = np.concatenate(grid)
    omega = np.unique(omega[(omega >= low) & (omega <= high)])
    cuts = sorted({a.omega for a in on_axis if low < a.omega})
    segments, start = [], low
    for cut in [*cuts, np.inf]:
        end = cut * (1 - GAP) if np.isfinite(cut) else high
        inside = omega[(omega > start) & (omega < min(end, high))]
        if start < min(end, high):
            segments.append(_refine(r, np.array([start, *inside, min(end, high)]), delay))
        start = cut * (1 + GAP)
    return segments


def _refine(r: Realization, omega: np.ndarray, delay: float) -> np.ndarray:
    for _ in range(14):
        L, _ = r.response(omega)
        L = L * np.exp(-1j * omega * delay)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.log(L[1:] / L[:-1])
        coarse = ~((np.abs(step.real) < 0.3) & (np.abs(step.imag) < 0.15)) & (np.diff(omega) > 1e-12 * omega[1:])
        if delay:  # a delay turns L without end, which does not matter where |L| is small
            coarse &= np.maximum(np.abs(L[1:]), np.abs(L[:-1])) > 0.3
        if not coarse.any() or len(omega) > 40_000:
            break
        omega = np.sort(np.concatenate([omega, np.sqrt(omega[1:] * omega[:-1])[coarse]]))
    return omega


def find_hidden_unstable(r: Realization) -> tuple[complex, ...]:
    """Return the hidden poles beyond the limit, in the planes of s or z.

    Coinciding poles on the limit scatter to both sides and are left out.
    """
    if not len(r.hidden):
        return ()
    _, rest = split_axis_poles(r, r.hidden, max(r.scale, float(np.abs(r.hidden).max())))
    beyond = rest[rest.real > 0]
    return tuple(complex(p) for p in (np.exp(beyond * r.dt) if r.dt else beyond))
