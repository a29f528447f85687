"""The delays of a continuous linear system, in the one form in which the package writes them.

The form is a linear fractional one: the delays are closed around matrices. Loops, responses and poles take it as it is,
exact in e^(−s τ); Padé's approximation makes matrices alone of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...blocks.core import explain_calls
from ...blocks.library import PadeDelay
from .state_space import FourMatrices

RIGHT = 0.01
"""Error of Padé's approximation, in parts of its input, up to which it is called right."""


@explain_calls
@dataclass(frozen=True, eq=False)
class LinearDelays:
    """The delays of a continuous linear system, closed around its matrices A, B, C and D.

    ẋ = A x + B u + G w, z = Z x + F u + H w, y = C x + D u + E w, with wᵢ(t) = zᵢ(t − τᵢ).

    A, B, C and D are those of whoever has the delays, such as a `Linearization`; methods take them. Numbers may be
    complex, with slopes.

    Attributes
    ----------
    names : tuple of str
        Outputs of the `TransportDelay` blocks, entry by entry.
    times : ndarray, shape (m,)
        τ in s.
    G, Z, H, E, F : ndarray
        Matrices of shapes (states, m), (m, states), (m, m), (outputs, m) and (m, inputs).
    """

    names: tuple[str, ...]
    times: np.ndarray
    G: np.ndarray
    Z: np.ndarray
    H: np.ndarray
    E: np.ndarray
    F: np.ndarray

    @classmethod
    def split(
        cls, rest: FourMatrices, times: np.ndarray, names: Sequence[str] = ()
    ) -> tuple[FourMatrices, LinearDelays]:
        """Return A, B, C and D, and the delays, of matrices that have w as their last inputs and z as last outputs.

        Parameters
        ----------
        rest : tuple of ndarray
            Matrices that `join` returns.
        times : ndarray, shape (m,)
            τ in s.
        names : sequence of str
            Names of the delays.
        """
        A, B, C, D = rest
        q, p = B.shape[1] - len(times), len(C) - len(times)
        late = cls(tuple(names), times, G=B[:, q:], Z=C[p:], H=D[p:, q:], E=D[:p, q:], F=D[p:, :q])
        return (A, B[:, :q], C[:p], D[:p, :q]), late

    def join(self, matrices: FourMatrices) -> FourMatrices:
        """Return the matrices with w behind the inputs u, and z behind the outputs y.

        Parameters
        ----------
        matrices : tuple of ndarray
            A, B, C and D, of shapes (states, states), (states, inputs), (outputs, states) and (outputs, inputs).
        """
        A, B, C, D = matrices
        return A, np.hstack([B, self.G]), np.vstack([C, self.Z]), np.block([[D, self.E], [self.F, self.H]])

    def settle(self, z: np.ndarray) -> np.ndarray:
        """Return w at rest, where a delay puts out what it takes in: the smallest solution of w = z + H w.

        Parameters
        ----------
        z : ndarray, shape (m,) or (m, n)
            z without the part of w.
        """
        return np.asarray(np.linalg.lstsq(np.eye(len(self.H)) - self.H, z, rcond=None)[0])

    def matrix_at(self, A: np.ndarray, s: complex) -> np.ndarray:
        """Return the matrix M of M (x, z) = (B, F) u at a point s, shape (states + m, states + m).

        Its determinant is zero at the poles.

        Parameters
        ----------
        A : ndarray, shape (states, states)
            A of the system.
        s : complex
            The point in 1/s.
        """
        e = np.exp(-s * self.times)
        return np.block([[s * np.eye(len(A)) - A, -self.G * e], [-self.Z, np.eye(len(e)) - self.H * e]])

    def feed_back(
        self, matrices: FourMatrices, K: np.ndarray, into: np.ndarray, out: np.ndarray
    ) -> tuple[FourMatrices, LinearDelays]:
        """Return the system with u = K y + into r, from r to out y.

        Parameters
        ----------
        matrices : tuple of ndarray
            A, B, C and D.
        K, into, out : ndarray
            Shapes (inputs, outputs), (inputs, r) and (any, outputs).

        Raises
        ------
        LinAlgError
            If I − D K is singular: a loop without a state that has no unique solution.
        """
        A, B, C, D = matrices
        loop = np.eye(len(D)) - D @ K
        # y = (I − D K)⁻¹ (C x + E w + D into r)
        yx, yw, yr = (np.linalg.solve(loop, part) for part in (C, self.E, D @ into))
        ux, uw, ur = K @ yx, K @ yw, into + K @ yr
        G, Z, H = self.G + B @ uw, self.Z + self.F @ ux, self.H + self.F @ uw
        late = LinearDelays(self.names, self.times, G, Z, H, out @ yw, self.F @ ur)
        return (A + B @ ux, B @ ur, out @ yx, out @ yr), late

    def approximate(self, matrices: FourMatrices, orders: Sequence[int]) -> FourMatrices:
        """Return A, B, C and D with Padé's approximations of the delays behind the states; `PadeDelay` has theirs.

        Parameters
        ----------
        matrices : tuple of ndarray
            A, B, C and D.
        orders : sequence of int
            Order of each approximation.

        Raises
        ------
        LinAlgError
            If a way around the delays without a state has no unique solution.
        """
        A, B, C, D = matrices
        G, Z, H, E, F = self.G, self.Z, self.H, self.E, self.F
        m, q = len(self.times), sum(orders)
        kind = np.result_type(A, G, self.times)
        Ap, Bp, Cp, Dp = (np.zeros(shape, dtype=kind) for shape in ((q, q), (q, m), (m, q), (m, m)))
        begin = 0
        for i, (time, order) in enumerate(zip(self.times, orders, strict=True)):
            matrix, column = PadeDelay(delay=1.0, order=order).ladder()
            where, sign = slice(begin, begin + order), (-1.0) ** order
            Ap[where, where], Bp[where, i] = matrix * 2.0 / time, column * 2.0 / time
            Cp[i, begin], Dp[i, i] = -sign * column[0], sign
            begin += order
        # w = Cp p + Dp z, z = Z x + F u + H w
        loop = np.eye(m) - Dp @ H
        wx, wu, wp = (np.linalg.solve(loop, part) for part in (Dp @ Z, Dp @ F, Cp))
        whole = np.block([[A + G @ wx, G @ wp], [Bp @ (Z + H @ wx), Ap + Bp @ H @ wp]])
        return whole, np.vstack([B + G @ wu, Bp @ (F + H @ wu)]), np.hstack([C + E @ wx, E @ wp]), D + E @ wu


def find_pade_limit(order: int) -> float:
    """Return the ω τ up to which Padé's approximation of a delay, an all-pass, is right to 1 % of its input."""
    one, none = np.ones((1, 1)), np.zeros((0, 0))
    row, column, empty = np.zeros((1, 0)), np.zeros((0, 1)), np.zeros((1, 1))
    late = LinearDelays(("delay",), np.ones(1), G=column, Z=row, H=empty, E=one, F=one)
    A, B, C, D = late.approximate((none, column, row, empty), [order])
    x = np.geomspace(0.01, 4.0 * order + 4.0, 4000)
    made = np.array([(C @ np.linalg.solve(1j * w * np.eye(order) - A, B) + D)[0, 0] for w in x])
    return float(x[int(np.argmax(np.abs(made - np.exp(-1j * x)) > RIGHT))])
