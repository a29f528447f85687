"""A loop as balanced matrices, with its frequency response and its closed-loop poles."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ...blocks.core import LoopwrightError, ParameterError
from .loop_model import LoopModel
from .number import explain_singular
from .poles_and_zeros import Features, split_axis_poles, transmission_zeros
from .state_space import inexactness_of, read_coefficients, read_matrices
from .transfer_functions import Coefficients

if TYPE_CHECKING:
    from .state_space import LinearSystem

Matrices = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
HIDDEN = 1e-11
"""Relative size of a coupling below which a mode counts as hidden."""
STRUCTURE = 1e-14
"""Size of an entry, relative to the largest after scaling, below which it is a zero that rounding has changed."""
ROUNDING = (1e-8, 1e-10, 1e-12)
"""Sizes below which an entry may be such a zero; each is tried, and kept if the response stays the same."""
MARGINAL = 1e-13
"""Distance from the limit of stability, relative to the largest pole of open and closed loop, that counts as none."""
ROUNDOFF = 2e-15
"""Relative size of the rounding in a solution of linear equations: nine times that of a number."""
LIGHTLY_DAMPED = 0.3
"""Damping ratio of a pole below which a response is drawn at more frequencies around it."""
SCATTER = 1e-12
"""Relative change of a matrix that may have moved the eigenvalues of a hidden part: some hundred roundings."""
LARGE = 1e4
"""|L| above which a difference does not show in the closed loop."""


@dataclass(frozen=True, eq=False)
class Realization(LoopModel):
    """A linear system (p I − A) x = B u, y = C x + D u with p = s, or p = z − 1 where it is sampled.

    Without the shift z − 1 several poles at z = 1 would cancel all digits far below the sampling frequency. ``hidden``
    are the poles, in the plane of p, that the reduction has removed, and ``hidden_errors`` how far rounding may have
    moved each. ``coefficients`` are those of the transfer function in z that was realized. ``inexactness`` is the
    relative error of the entries as they were given. ``turned`` is the norm of the matrix that the reduction has turned
    into this A and a hidden part, 0 where it has turned none: its rounding is in A, which may be much smaller.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    dt: float
    hidden: np.ndarray
    coefficients: Coefficients | None = None
    inexactness: float = 0.0
    hidden_errors: np.ndarray = field(default_factory=lambda: np.zeros(0))
    turned: float = 0.0

    @classmethod
    def of(cls, loop: LinearSystem, *, delay: int = 0) -> Realization:
        """Return the balanced, minimal realization of a linear system, with whole samples of delay in series."""
        name = str(getattr(loop, "name", None) or "loop")
        try:
            A, B, C, D, dt = read_matrices(loop)
        except LoopwrightError as error:
            raise error.at(block=name) from None
        if dt is None or dt is True:
            raise ParameterError(
                f"found dt={dt}; expected 0 (continuous) or the sample time in s. Set it: control.ss(A, B, C, D, dt).",
                block=name,
                port="dt",
            )
        if int(delay) != delay or delay < 0 or (delay and not dt):
            raise ParameterError(
                f"found a delay of {delay!r} samples; expected a whole number, not negative, and 0 for a continuous "
                "loop. For a continuous one take control.pade.",
                block=name,
                port="delay",
            )
        if not all(np.isfinite(m).all() for m in (A, B, C, D)):
            raise ParameterError(
                "found NaN or infinity in A, B, C or D; expected finite entries. Look at the operating point.",
                block=name,
            )
        if dt:
            A = A - np.eye(len(A))
        if len(A):  # a feedthrough left by rounding would make crossings near infinity
            size = max(float(np.abs(M).max(initial=0.0)) for M in _scale(A, B, C))
            D = np.where(np.abs(D) <= STRUCTURE * size, 0.0, D)
        A, B, C, D = _delay_inputs(A, B, C, D, int(delay))
        with explain_singular(name):
            made = cls(*_balance(A, B, C), D, float(dt), np.zeros(0), None, inexactness_of(loop)).reduce()
        # scaled once more, with input and output: rounding in A alone may have set the first scales
        A, B, C = _scale(made.A, made.B, made.C)
        return replace(made, A=A, B=B, C=C, coefficients=read_coefficients(loop))

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.A)

    @property
    def late(self) -> float:
        """0: poles and zeros make all turns of the response."""
        return 0.0

    @property
    def settled(self) -> float:
        """Infinity: without delays the response comes to a single value at infinite frequency."""
        return np.inf

    @property
    def end_error(self) -> float:
        """Relative error of L at infinite frequency, D."""
        return 1e-15

    @property
    def gain_at_infinity(self) -> float:
        """|L| of a loop with one channel at infinite frequency."""
        return abs(float(self.D[0, 0]))

    def matrix(self, s: np.ndarray) -> np.ndarray:
        """Return the transfer matrix at the points s, shape (..., outputs, inputs)."""
        return np.asarray(self.D + self.C @ self._states(np.atleast_1d(s)))

    def values(self, s: np.ndarray, slope: complex = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Return L and ``slope`` times dL/ds of a loop with one channel at the points s."""
        x = self._states(s)
        rate = self.dt * (1 + self.point(s)) if self.dt else np.ones_like(s)
        twice = self._solve(s, x)
        return (self.D + self.C @ x)[:, 0, 0], -slope * rate * (self.C @ twice)[:, 0, 0]

    def error(self, omega: float) -> float:
        """Return an estimate of the relative error of L at ω.

        It is the difference to the adjoint solution, and what the rounding of a transfer function's coefficients makes,
        or the inexactness of the entries.
        """
        s = np.array([1j * omega])
        states, costates = self._states(s)[0], _transpose(self)._states(s)[0].T
        direct, adjoint = self.D + self.C @ states, self.D + costates @ self.B
        given = 0.0 if self.coefficients is None else self.coefficients.error(complex(np.exp(s[0] * self.dt)))
        if self.inexactness:
            A, B, C, D = (np.abs(M) for M in (self.A, self.B, self.C, self.D))
            A, x, y = A + (np.eye(len(A)) if self.dt else 0.0), np.abs(states), np.abs(costates)
            moved = float(np.max(y @ A @ x + y @ B + C @ x + D))
            given += self.inexactness * moved / (float(np.max(np.abs(direct))) + 1e-300)
        return given + 1e-13 + 10 * float(np.max(np.abs(direct - adjoint)) / (np.max(np.abs(direct)) + 1e-300))

    def closed_matrix(self, factor: complex | np.ndarray = 1.0) -> np.ndarray:
        """Return the closed-loop matrix A − B F (I + D F)⁻¹ C; F, a number or a matrix, multiplies the loop."""
        m = len(self.D)
        F = factor * np.eye(m) if np.ndim(factor) == 0 else np.asarray(factor)
        return np.asarray(self.A - self.B @ F @ np.linalg.solve(np.eye(m) + self.D @ F, self.C))

    def eigenvalues(self, factor: complex | np.ndarray = 1.0) -> np.ndarray:
        """Return the closed-loop poles in the plane of p; see `closed_matrix`."""
        return np.linalg.eigvals(self.closed_matrix(factor))

    def count_unstable(self, factor: complex | np.ndarray = 1.0) -> int:
        """Return the number of closed-loop poles that are not stable; poles on the limit, up to rounding, count."""
        poles = self.eigenvalues(factor)
        return int(np.sum(self.growth(poles) >= -self._marginal(poles)))

    def find_marginal(self) -> np.ndarray:
        """Return the closed-loop poles on the limit of stability, up to rounding, in the plane of p."""
        poles = self.eigenvalues()
        return np.asarray(poles[np.abs(self.growth(poles)) <= self._marginal(poles)])

    @cached_property
    def _largest_pole(self) -> float:
        return float(np.abs(np.linalg.eigvals(self.A)).max(initial=0.0))

    def _marginal(self, poles: np.ndarray) -> float:
        """Return the rounding of closed-loop poles: they are differences of numbers as large as the open-loop poles."""
        return MARGINAL * max(self._largest_pole, float(np.abs(poles).max(initial=0.0)))

    @cached_property
    def scale(self) -> float:
        """Frobenius norm of A."""
        return float(np.linalg.norm(self.A)) if self.order else 0.0

    @property
    def rounding_scale(self) -> float:
        """Size to which the rounding of the poles is relative."""
        return max(self.scale, self.turned)

    def delay_by(self, samples: int) -> Realization:
        """Return this sampled system with samples of delay in series."""
        A, B, C, D = _delay_inputs(self.A, self.B, self.C, self.D, samples)
        return replace(self, A=A, B=B, C=C, D=D, coefficients=None)

    def reduce(self) -> Realization:
        """Return the controllable and observable part; the poles of the rest go to ``hidden``."""
        whole = self._replace_by(*_keep_connected(self, STRUCTURE))
        for tolerance in ROUNDING:
            fewer = whole._replace_by(*_keep_connected(whole, tolerance))
            if fewer.order < whole.order and fewer.agrees(whole):
                whole = fewer
        part, first = _split_uncontrollable(whole)
        part, second = _split_uncontrollable(_transpose(part))
        part = replace(_transpose(part), turned=whole.rounding_scale)
        return whole._replace_by(part, np.hstack([first, second]))

    @cached_property
    def features(self) -> Features:
        """Poles, zeros and closed-loop poles, which shape the response."""
        axis_poles, poles = split_axis_poles(self, np.linalg.eigvals(self.A), self.rounding_scale)
        zeros = self.zeros()
        axis_zeros, zeros = split_axis_poles(self, zeros, max(self.scale, float(np.abs(zeros).max(initial=0.0))))
        try:
            closed = self.logarithm(self.eigenvalues())
        except np.linalg.LinAlgError:
            closed = np.zeros(0)
        return Features(axis_poles, poles, axis_zeros, zeros, closed[np.isfinite(closed)])

    def zeros(self) -> np.ndarray:
        """Return the zeros of a loop with one channel."""
        return transmission_zeros(self.A, self.B, self.C, self.D)

    def count_open(self) -> int:
        """Return the number of poles of L beyond the limit of stability; those on it are not counted."""
        return self.features.unstable_poles()

    def grid(self, low: float, high: float, count: int) -> np.ndarray:
        """Return frequencies in rad/s to draw a response at: ``count`` over the logarithm, and more at resonances."""
        top = min(high, self.nyquist * (1 - 1e-6))
        s = self.logarithm(np.linalg.eigvals(self.A))
        peaks = [abs(p) for p in s if p.imag > 0 and abs(p.real) < LIGHTLY_DAMPED * abs(p)]
        near = np.geomspace(1e-5, 0.3, 60)
        w = np.concatenate([np.geomspace(low, top, count), *(peak * (1 + np.append(near, -near)) for peak in peaks)])
        return np.unique(w[(w >= low) & (w <= top)])

    def agrees(self, other: Realization) -> bool:
        """Whether the responses are the same to 1e-9 around every open-loop and closed-loop pole.

        Very large responses are left out: they occur near several poles at s = 0, which scatter, and don't matter.
        """
        p = [np.linalg.eigvals(other.A)]
        if other.B.shape[1] == len(other.C) and np.linalg.cond(np.eye(len(other.D)) + other.D) < 1e12:
            p.append(other.eigenvalues())
        s = self.logarithm(np.concatenate(p))
        s = s[np.isfinite(s)]
        s = s[np.abs(s) > 1e-7 * np.abs(s).max(initial=0.0)]
        around = np.outer(np.abs(s) if len(s) else [1.0], np.geomspace(0.3, 3, 7)).ravel()
        omega = np.concatenate([around, np.abs(s.imag), np.abs(s.imag) + np.abs(s.real)]) * (1 + 1e-9)
        omega = omega[(omega < self.nyquist) & (omega > 1e-3 * around.min())]
        one, two = self.matrix(1j * omega), other.matrix(1j * omega)
        size, apart = np.max(np.abs(two), axis=(1, 2)), np.max(np.abs(one - two), axis=(1, 2))
        counts = size < LARGE
        tolerance = 1e-9 * size + other.rounding(1j * omega)
        return bool(counts.any() and np.all(apart[counts] <= tolerance[counts]))

    def rounding(self, s: np.ndarray) -> np.ndarray:
        """Return a bound of the rounding error of the transfer matrix at points s, shape (...).

        Solving (p I − A) x = B u is exact for a matrix that differs by some ε of its norm, which moves C x by the
        solution, the adjoint one and that difference (Higham, Accuracy and Stability of Numerical Algorithms, 7.1).
        """
        states, costates = self._states(s), _transpose(self)._states(s)
        size = self.order * (self.scale + np.abs(self.point(s)))
        x, y = (np.linalg.norm(found, axis=(1, 2)) for found in (states, costates))
        return np.asarray(ROUNDOFF * size * x * y)

    def _replace_by(self, part: Realization, hidden: np.ndarray) -> Realization:
        """Return a part of this system if its response is the same, with ``hidden`` added; else this system.

        ``hidden`` are poles and their errors, shape (2, n).
        """
        if part.order == self.order:
            return self
        A, B, C = _scale(part.A, part.B, part.C)
        poles, errors = np.append(self.hidden, hidden[0]), np.append(self.hidden_errors, hidden[1].real)
        part = replace(self, A=A, B=B, C=C, hidden=poles, hidden_errors=errors, turned=part.turned)
        poles = self.logarithm(np.linalg.eigvals(self.A))
        size = np.abs(poles[np.isfinite(poles)])
        top = min(10 * size.max(initial=1.0), self.nyquist)
        s = 1j * np.geomspace(top * 1e-5, top, 101) * (1 + 1e-4)
        before, after = self.matrix(s), part.matrix(s)
        size = np.max(np.abs(before), axis=(1, 2)) + 1e-300
        # far above 1 an error does not show in the closed loop, and integrators amplify rounding
        allowed = max(1e-9, 100 * self.inexactness) * size * np.maximum(1.0, np.sqrt(size)) + self.rounding(s)
        return part if np.all(np.max(np.abs(before - after), axis=(1, 2)) < allowed) else self

    def _solve(self, s: np.ndarray, right: np.ndarray) -> np.ndarray:
        return np.linalg.solve(self.point(s)[:, None, None] * np.eye(self.order) - self.A, right)

    def _states(self, s: np.ndarray) -> np.ndarray:
        return self._solve(s, np.broadcast_to(self.B.astype(complex), (len(s), *self.B.shape)))


def _transpose(r: Realization) -> Realization:
    return replace(r, A=r.A.T, B=r.C.T, C=r.B.T, D=r.D.T, coefficients=None)


def _delay_inputs(A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray, samples: int) -> Matrices:
    """Put a delay of some samples behind the inputs: z d = u, so p d = u − d, one sample after the other."""
    if not samples:
        return A, B, C, D
    n, m = len(A), B.shape[1]
    size = n + samples * m
    late, entered, seen = np.zeros((size, size)), np.zeros((size, m)), np.zeros((len(C), size))
    late[:n, :n], late[:n, n : n + m] = A, B
    late[n:, n:] = np.eye(samples * m, k=m) - np.eye(samples * m)
    entered[size - m :] = np.eye(m)
    seen[:, :n], seen[:, n : n + m] = C, D
    return late, entered, seen, np.zeros_like(D)


def _balance(A: np.ndarray, B: np.ndarray, C: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scale the states by powers of two, so that A's rows and columns get one size."""
    if not len(A):
        return A, B, C
    d = _scales(A)
    return A * d / d[:, None], B / d[:, None], C * d


def _scales(M: np.ndarray) -> np.ndarray:
    """Return the factors that balance a matrix, powers of two."""
    from scipy.linalg import matrix_balance

    with np.errstate(invalid="ignore"):  # SciPy casts the factors to whole numbers, for which they may be too large
        _, (d, _) = matrix_balance(M, permute=False, separate=True)
    return np.asarray(d)


def _scale(A: np.ndarray, B: np.ndarray, C: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scale the states so that input, states and output get one size.

    A chain of integrators has no loop that fixes its scale: balancing A alone would scale it by rounding errors.
    """
    n = len(A)
    if not n:
        return A, B, C
    whole = np.block([[A, np.linalg.norm(B, axis=1)[:, None]], [np.linalg.norm(C, axis=0)[None, :], np.zeros((1, 1))]])
    d = _scales(whole)
    d = d[:n] / d[n]
    return A * d / d[:, None], B / d[:, None], C * d


def _keep_connected(r: Realization, tolerance: float) -> tuple[Realization, np.ndarray]:
    """Return the states that couplings above a tolerance connect to input and output, and `_hidden_poles`."""
    A, B, C = _scale(r.A, r.B, r.C)
    n = len(A)
    whole = np.block([[A, B], [C, np.zeros((len(C), B.shape[1]))]])
    size = np.abs(whole).max(initial=0.0)
    A, B, C = (np.abs(M) > tolerance * size for M in (A, B, C))
    reached, seen = B.any(axis=1), C.any(axis=0)
    for _ in range(n):
        reached, seen = reached | A[:, reached].any(axis=1), seen | A[seen].any(axis=0)
    keep = reached & seen
    if keep.all():
        return r, np.zeros((2, 0))
    part = replace(r, A=r.A[np.ix_(keep, keep)], B=r.B[keep], C=r.C[:, keep])
    return part, _hidden_poles(r, r.A[np.ix_(~keep, ~keep)])


def _split_uncontrollable(r: Realization) -> tuple[Realization, np.ndarray]:
    """Return the controllable part and `_hidden_poles` of the rest, by a block Krylov staircase."""
    if not r.order:
        return r, np.zeros((2, 0))
    size = np.linalg.norm(r.B, axis=0)
    hidden = max(HIDDEN, 10 * r.inexactness)
    new = _range(r.B / np.where(size > 0, size, 1.0), hidden)
    Q = new
    while new.shape[1] and Q.shape[1] < r.order:
        reached = r.A @ new
        for _ in range(2):
            reached = reached - Q @ (Q.T @ reached)
        new = _range(reached, hidden * r.scale)
        Q = np.hstack([Q, new])
    if Q.shape[1] == r.order:
        return r, np.zeros((2, 0))
    whole, _ = np.linalg.qr(np.hstack([Q, np.eye(r.order)]))
    rest = whole[:, Q.shape[1] :]
    part = replace(r, A=Q.T @ r.A @ Q, B=Q.T @ r.B, C=r.C @ Q)
    return part, _hidden_poles(r, rest.T @ r.A @ rest)


def _hidden_poles(r: Realization, M: np.ndarray) -> np.ndarray:
    """Return the poles of the hidden part M of a system and how far rounding may have moved each, shape (2, n).

    A change E of M moves a simple eigenvalue by up to ‖E‖/|yᴴx|, x and y its unit eigenvectors (Golub and Van Loan,
    Matrix Computations, 7.2.2). Of m coinciding ones, which scatter by δ = ‖E‖^(1/m), the bound is some δ/m as well.
    """
    from scipy.linalg import eig

    poles, y, x = eig(M, left=True, right=True)
    change = max(SCATTER, 10 * r.inexactness) * r.rounding_scale
    return np.array([poles, change / np.maximum(np.abs(np.sum(y.conj() * x, axis=0)), 1e-300)])


def _range(M: np.ndarray, least: float) -> np.ndarray:
    """Return an orthonormal basis of the columns that are larger than a hidden coupling."""
    U, sigma, _ = np.linalg.svd(M, full_matrices=False)
    return np.asarray(U[:, sigma > least])
