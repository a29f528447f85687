"""Responses of linear systems with delays over time, by the method of steps with spectral elements.

On an element of time the states are a polynomial through Chebyshev-Lobatto points that fulfils the equations of
`LinearDelays` at all of them but the first (collocation, which is stiffly stable); w comes from past elements. Elements
end where a delay lets out a jump, or a kink that such a jump has made, up to its eighth derivative: within an element
all is smooth. An element is halved until the last Chebyshev coefficients are small.
"""

from __future__ import annotations

import bisect
import itertools

import numpy as np

from ...blocks.core import ConfirmationError
from .linear_delays import LinearDelays
from .state_space import FourMatrices

NODES = 13
"""Points of an element."""
ORDERS = 9
"""Delays one after the other, up to which a jump that has passed through them ends an element."""
SMALL = 1e-12
"""Last Chebyshev coefficients, relative to the largest value so far, at which an element is short enough."""
MOST_ELEMENTS = 200_000
"""Elements after which a response is given up."""


def respond(matrices: FourMatrices, late: LinearDelays, u: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the outputs of a system with delays at rising times from 0 on, from rest, with constant inputs."""
    return _Steps(*matrices, late).respond(u, times)


class _Steps:
    """The method of steps for a system with delays and constant inputs."""

    def __init__(self, A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray, late: LinearDelays):
        self.A, self.B, self.C, self.D, self.late = A, B, C, D, late
        self._solvers: dict[float, np.ndarray] = {}

    def respond(self, u: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Return the outputs at rising times."""
        late, tau = self.late, self.late.times
        end = float(times[-1])
        edges = self._edges(end)
        longest = min([float(tau.min(initial=np.inf)), end, *([0.5 / self._fastest()] if len(self.A) else [])])
        grid, points = _chebyshev(NODES)
        begins, zs, ys, lengths = list[float](), list[np.ndarray](), list[np.ndarray](), list[float]()
        t, x, h, size = 0.0, np.zeros(len(self.A)), longest * 2.0**-6, 1e-300
        while t < end * (1 - 1e-15):
            k = bisect.bisect_right(edges, t * (1 + 1e-14) + 1e-300)
            room = (edges[k] if k < len(edges) else end) - t
            step = min(h, float(tau.min(initial=np.inf)))
            step = room if step > 0.7 * room else step
            w = self._outputs_of_delays(t, step, grid, begins, lengths, zs, points)
            X = self._collocate(x, self.B @ u + w @ late.G.T, step)
            size = max(size, float(np.max(np.abs(X), initial=0.0)), float(np.max(np.abs(w), initial=0.0)))
            bent = float(np.max(np.abs(_last_coefficients(np.hstack([X, w]))), initial=0.0))
            if bent > SMALL * size and step > 1e-9 * longest:
                h = 0.5 * step
                continue
            z = X @ late.Z.T + late.F @ u + w @ late.H.T
            begins.append(t)
            lengths.append(step)
            zs.append(z)
            ys.append(X @ self.C.T + self.D @ u + w @ late.E.T)
            x, t = X[-1], t + step if step < room else (edges[k] if k < len(edges) else end)
            h = min(2.0 * step, 16.0 * longest) if bent < 1e-2 * SMALL * size else step
            if len(begins) > MOST_ELEMENTS:
                raise ConfirmationError(
                    f"found a response that takes more than {MOST_ELEMENTS} elements up to t = {t:.6g} s; expected "
                    "fewer. Ask for a shorter time.",
                    block="delays",
                )
        return np.array([self._read(time, begins, lengths, ys, grid, points) for time in times])

    def _fastest(self) -> float:
        return float(np.max(np.abs(np.linalg.eigvals(self.A)), initial=1e-300)) or 1e-300

    def _edges(self, end: float) -> list[float]:
        """Return the times at which a jump or one of its kinks comes out of delays."""
        found = {0.0}
        front, late = {0.0}, self.late
        for _ in range(ORDERS if not late.H.any() else 10 * ORDERS):
            front = {round(t + tau, 14) for t, tau in itertools.product(front, late.times) if t + tau < end} - found
            if not front or len(found) > 20_000:
                break
            found |= front
        return sorted(found - {0.0})

    def _collocate(self, x: np.ndarray, forced: np.ndarray, h: float) -> np.ndarray:
        """Return the states at the points of an element, shape (points, states)."""
        n = len(x)
        if not n:
            return np.zeros((NODES, 0))
        if h not in self._solvers:
            if len(self._solvers) > 64:
                self._solvers.clear()
            M = np.kron(_differentiate(NODES)[1:, 1:] / h, np.eye(n)) - np.kron(np.eye(NODES - 1), self.A)
            self._solvers[h] = np.linalg.inv(M)
        right = forced[1:] - np.outer(_differentiate(NODES)[1:, 0] / h, x)
        return np.vstack([x, (self._solvers[h] @ right.ravel()).reshape(NODES - 1, n)])

    def _outputs_of_delays(
        self,
        t: float,
        h: float,
        grid: np.ndarray,
        begins: list[float],
        lengths: list[float],
        zs: list[np.ndarray],
        weights: np.ndarray,
    ) -> np.ndarray:
        """Return the outputs of the delays at the points of an element, shape (points, delays)."""
        w = np.zeros((NODES, len(self.late.times)))
        for i, tau in enumerate(self.late.times):
            middle = t + 0.5 * h - tau
            if middle <= 0.0:
                continue
            for j, part in enumerate(grid):
                at = t + part * h - tau
                k = bisect.bisect_right(begins, at + 1e-9 * (middle - at)) - 1
                w[j, i] = _interpolate((at - begins[k]) / lengths[k], zs[k][:, i], grid, weights)
        return w

    def _read(
        self, t: float, begins: list[float], lengths: list[float], ys: list[np.ndarray], grid: np.ndarray, p: np.ndarray
    ) -> np.ndarray:
        k = min(max(bisect.bisect_right(begins, t) - 1, 0), len(begins) - 1)
        return _interpolate((t - begins[k]) / lengths[k], ys[k], grid, p)


def _chebyshev(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the Chebyshev-Lobatto points in [0, 1] and their barycentric weights."""
    angles = np.pi * np.arange(count) / (count - 1)
    weights = (-1.0) ** np.arange(count)
    weights[[0, -1]] *= 0.5
    return 0.5 * (1.0 - np.cos(angles)), weights


def _differentiate(count: int) -> np.ndarray:
    """Return the matrix that differentiates a polynomial through the points."""
    grid, weights = _chebyshev(count)
    apart = grid[:, None] - grid[None, :] + np.eye(count)
    D = weights[None, :] / weights[:, None] / apart
    np.fill_diagonal(D, 0.0)
    np.fill_diagonal(D, -D.sum(axis=1))
    return np.asarray(D)


def _last_coefficients(values: np.ndarray) -> np.ndarray:
    """Return the last two Chebyshev coefficients of columns of values at the points."""
    count = len(values)
    k = np.arange(count)
    weights = np.ones(count)
    weights[[0, -1]] = 0.5
    rows = [np.cos(np.pi * n * k / (count - 1)) * weights * 2.0 / (count - 1) for n in (count - 2, count - 1)]
    return np.asarray(np.array(rows) @ values)


def _interpolate(part: float, values: np.ndarray, grid: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the polynomial through values at the points, at a part of the element."""
    apart = part - grid
    exact = np.flatnonzero(np.abs(apart) < 1e-15)
    if exact.size:
        return np.asarray(values[exact[0]])
    factors = weights / apart
    return np.asarray(factors @ values / factors.sum())
