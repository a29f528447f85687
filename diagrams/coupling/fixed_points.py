"""Values that a function returns unchanged, found by Newton's method and by homotopy.

Both need nothing but the function: its derivatives are differences, of one evaluation for each unknown. Newton's steps
are shortened until the next simplified step would be shorter (Deuflhard's natural monotonicity test), which does not
depend on the units of the unknowns. Where no part of a step helps, the solution is followed along a curve: from the
first guess, which solves y = y₀ + λ (f(y) − y₀) at λ = 0, to λ = 1, by its length, so that it may turn back in λ
(Chow, Mallet-Paret, Yorke 1978; for almost every guess the curve has no branches).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Function = Callable[[np.ndarray], np.ndarray]

DIFFERENCE = 1.5e-8
"""Step of a difference, relative to the size of the unknown."""
ROUNDING = 8.0 * float(np.finfo(float).eps)
"""Relative rounding of a function's values and terms."""
ROUGH = 1e-11
"""Relative length of a Newton step below which one that can't be made shorter is rounding, too."""
SMALL = 1e-6
"""Part of the largest value of an unknown so far, below which it counts as that part."""
FAR = 1e5
"""Length at which a curve runs away, in sizes of the first guess."""
_ITERATIONS = 40
_SHORTEST = 2.0**-12


class _TooManyEvaluationsError(Exception):
    """The function was evaluated as often as is allowed."""


class _Counted:
    """A function whose evaluations are counted, and whose unknowns have sizes."""

    def __init__(self, function: Function, most: int):
        self._function, self.left = function, most
        self.seen, self.scale = np.zeros(0), np.zeros(0)

    def __call__(self, y: np.ndarray) -> np.ndarray:
        if not self.left:
            raise _TooManyEvaluationsError
        self.left -= 1
        return np.asarray(self._function(y), dtype=float)

    def take_sizes(self, y: np.ndarray, f: np.ndarray) -> None:
        """Take the sizes of the unknowns at a point: their own, or a small part of the largest before."""
        self.seen = np.maximum(self.seen, np.abs(y)) if self.seen.size else np.abs(y)
        floor = np.where(self.seen > 0.0, SMALL * self.seen, np.where(f != 0.0, np.abs(f), 1.0))
        self.scale = np.maximum(np.abs(y), floor)

    def length(self, step: np.ndarray) -> float:
        """Return the largest entry of a step, relative to the sizes of the unknowns."""
        return float(np.max(np.abs(step) / self.scale, initial=0.0))

    def slopes(self, y: np.ndarray, f: np.ndarray) -> np.ndarray:
        """Return the Jacobian by differences; NaN where a neighbour fails on both sides."""
        columns = []
        for i, size in enumerate(self.scale):
            for sign in (1.0, -1.0):
                near = y.copy()
                near[i] += sign * DIFFERENCE * size
                column = (self(near) - f) / (near[i] - y[i])
                if np.all(np.isfinite(column)):
                    break
            columns.append(column)
        return np.array(columns).T.reshape(len(y), len(y))


def find_fixed_point(function: Function, guess: np.ndarray, most: int | None = None) -> np.ndarray | None:
    """Return values that a function returns unchanged, to rounding; None where none are found."""
    # At the guess the function must have a value; elsewhere it may be NaN or infinite.
    start = np.array(guess, dtype=float)
    counted = _Counted(function, 500 + 100 * len(start) if most is None else most)
    try:
        f = counted(start)
        if not np.all(np.isfinite(f)):
            return None
        counted.take_sizes(start, f)
        found = _by_newton(counted, start, f)
        return found if found is not None else _by_homotopy(counted, start, f)
    except _TooManyEvaluationsError:
        return None


def _by_newton(function: _Counted, y: np.ndarray, f: np.ndarray) -> np.ndarray | None:
    """Return the solution that Newton's method leads to; None where it stops on the way."""
    for _ in range(_ITERATIONS):
        function.take_sizes(y, f)
        J = function.slopes(y, f)
        A = np.eye(len(y)) - J
        step = _solve(A, f - y)
        if step is None:
            return None
        length = function.length(step)
        noise = ROUNDING * (np.abs(np.linalg.inv(A)) @ (np.abs(J) @ np.abs(y) + np.abs(f)) + np.abs(y))
        if np.all(np.abs(step) <= noise):
            return y
        share = 1.0
        while share >= _SHORTEST:
            nearer = y + share * step
            there = function(nearer)
            if np.all(np.isfinite(there)):
                simplified = _solve(A, there - nearer)
                if simplified is not None and function.length(simplified) <= (1.0 - 0.25 * share) * length:
                    break
            share *= 0.5
        else:
            return y if length <= ROUGH else None
        y, f = nearer, there
    return None


def _solve(A: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    """Return the solution of linear equations; None of singular ones."""
    if not (np.all(np.isfinite(A)) and np.all(np.isfinite(b))):
        return None
    try:
        found = np.linalg.solve(A, b)
    except np.linalg.LinAlgError:
        return None
    return found if np.all(np.isfinite(found)) else None


def _by_homotopy(function: _Counted, start: np.ndarray, first: np.ndarray) -> np.ndarray | None:
    """Return a solution at the end of the curve from the first guess; None where the curve gets lost."""
    function.take_sizes(start, first)
    scale, n = np.maximum(function.scale, np.abs(first - start)), len(start)
    here, f = np.zeros(n + 1), first  # (y − start)/scale, and λ

    def values(at: np.ndarray) -> np.ndarray:
        return np.asarray(start + scale * at[:n])

    def residual(at: np.ndarray, made: np.ndarray) -> np.ndarray:
        return np.asarray(at[:n] - at[n] * (made - start) / scale)

    way, size = np.append(np.zeros(n), 1.0), 0.1
    while float(np.max(np.abs(here))) < FAR:
        function.take_sizes(values(here), f)
        J = function.slopes(values(here), f)
        if not np.all(np.isfinite(J)):
            return None
        H = np.column_stack([np.eye(n) - here[n] * J * scale / scale[:, None], -(f - start) / scale])
        tangent = np.linalg.svd(H)[2][-1]
        tangent = tangent if tangent @ way >= 0.0 else -tangent
        while True:
            reached = _return_to_curve(function, H, here + size * tangent, values, residual)
            if reached is not None and (reached[0] - here) @ tangent > 0.5 * size:
                break
            size *= 0.5
            if size < 1e-9:
                return None
        there, made, passes = reached
        if (here[n] - 1.0) * (there[n] - 1.0) <= 0.0 and there[n] != here[n]:
            between = here + (1.0 - here[n]) / (there[n] - here[n]) * (there - here)
            y = values(between)
            g = function(y)
            found = _by_newton(function, y, g) if np.all(np.isfinite(g)) else None
            if found is not None:
                return found
        here, f, way = there, made, tangent
        size *= 2.0 if passes <= 2 else 1.0
    return None


def _return_to_curve(
    function: _Counted,
    H: np.ndarray,
    at: np.ndarray,
    values: Function,
    residual: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> tuple[np.ndarray, np.ndarray, int] | None:
    """Return the point of the curve next to a predicted one, the function there, and the passes; None if it is far."""
    inverse, last = np.linalg.pinv(H), np.inf
    for count in range(1, 7):
        made = function(values(at))
        if not np.all(np.isfinite(made)):
            return None
        off = residual(at, made)
        length = float(np.max(np.abs(off), initial=0.0))
        if length <= 1e-7:
            return at, made, count
        if length > 0.5 * last:
            return None
        at, last = at - inverse @ off, length
    return None
