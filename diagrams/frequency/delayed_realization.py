"""A loop with delays and one channel: its response, and its closed loop's roots counted by the argument."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import ParameterError
from .delay_matrices import MARGINAL, DelayMatrices, sort_rightmost
from .loop_model import LoopModel
from .poles_and_zeros import AxisPole, Features, split_axis_poles
from .realization import ROUNDOFF, Realization

if TYPE_CHECKING:
    from .delayed_system import DelayedSystem

SHOWN = 24
"""Closed-loop poles that are shown, the rightmost."""
ZEROS_ORDER = 6
"""Order of Padé's approximation whose zeros say where a response bends."""
MOST_TURNS = 5000
"""Frequencies in even steps that are added where a response is drawn."""
SETTLED = 1e-3
"""Difference of L from its limit, relative to that and to 1 + L, that is left where it has settled."""
MOST_CYCLES = 60
"""Turns of all delays up to which a response that turns up to infinite frequency is scanned."""
SAMPLES = 400
"""Frequencies at which the distance of a response from its limit is measured."""
SECOND = 4.0
"""Factor of the second-order term of that distance."""
MOST_SIGNS = 10
"""Delays up to which the response at infinite frequency is looked at for all signs."""


@dataclass(frozen=True, eq=False)
class DelayedRealization(LoopModel):
    """A continuous loop with one channel: a rest with the delays τ closed around its last inputs and outputs.

    ``hidden`` are the poles that input or output doesn't see, with ``hidden_errors`` how far rounding may have moved
    each.
    """

    rest: Realization
    tau: np.ndarray
    hidden: np.ndarray
    hidden_errors: np.ndarray
    name: str = "loop"

    dt = 0.0

    @classmethod
    def of(cls, loop: DelayedSystem, *, delay: int = 0) -> DelayedRealization:
        """Return the realization of a loop without what its input or output doesn't see."""
        from control import ss

        name = str(loop.name or "loop")
        if delay:
            raise ParameterError(
                f"found a delay of {delay!r} samples; expected 0 for a continuous loop.", block=name, port="delay"
            )
        if (loop.ninputs, loop.noutputs) != (1, 1):
            raise ParameterError(
                f"found a loop with delays, {loop.ninputs} inputs and {loop.noutputs} outputs; expected one of each. "
                "Take one entry, L[0, 0], or a rational model of it, L.pade(order).",
                block=name,
            )
        whole = loop.characteristic()
        A, B, C, D = (np.asarray(getattr(loop.rest, k), dtype=float) for k in "ABCD")
        n, m = len(A), len(loop.delays)
        both = np.block([[A, B[:, 1:]], [C[1:], D[1:, 1:]]]) != 0.0
        reached, seen = np.append(B[:, 0], D[1:, 0]) != 0.0, np.append(C[0], D[0, 1:]) != 0.0
        # what the input reaches and the output sees, over states and delays, by structure
        for _ in range(n + m):
            reached, seen = reached | both[:, reached].any(axis=1), seen | both[seen].any(axis=0)
        keep = reached & seen
        x, w = np.flatnonzero(keep[:n]), np.flatnonzero(keep[n:])
        hidden = [
            pole
            for part in whole.parts
            if not np.all(np.append(keep[:n][part.states], keep[n:][part.delays]))
            for pole in _poles_of(whole.take(part))
        ]
        io = np.append(0, 1 + w)
        rest = ss(
            A[np.ix_(x, x)], B[np.ix_(x, io)], C[np.ix_(io, x)], D[np.ix_(io, io)], 0, remove_useless_states=False
        )
        rest.name, rest.inexactness = name, loop.inexactness
        r = Realization.of(rest)
        return cls(
            r,
            loop.delays[w],
            np.append(np.array(hidden, dtype=complex), r.hidden),
            np.append(np.zeros(len(hidden)), r.hidden_errors),
            name,
        )

    @property
    def order(self) -> int:
        """Number of states, and of delays."""
        return self.rest.order + len(self.tau)

    @property
    def inexactness(self) -> float:
        """Relative error of the entries as they were given."""
        return self.rest.inexactness

    @cached_property
    def at_infinity(self) -> np.ndarray:
        """Values of L at infinite frequency for all signs of the delays' factors; one without a way without a state."""
        D, m = self.rest.D, len(self.tau)
        if not m or not (D[0, 1:].any() and D[1:, 0].any()):
            return D[:1, 0]
        if m > MOST_SIGNS:
            raise ParameterError(
                f"found {m} delays in ways without a state; expected {MOST_SIGNS} at most. Put a lag into one.",
                block=self.name,
            )
        found = []
        for signs in itertools.product((1.0, -1.0), repeat=m):
            E = np.array(signs)
            found.append(D[0, 0] + (D[0, 1:] * E) @ np.linalg.solve(np.eye(m) - D[1:, 1:] * E, D[1:, 0]))
        return np.array(found)

    @property
    def gain_at_infinity(self) -> float:
        """Largest |L| at infinite frequency."""
        return float(np.max(np.abs(self.at_infinity)))

    @cached_property
    def D(self) -> np.ndarray:  # type: ignore[override]  # noqa: N802 - a field of a realization
        """L at infinite frequency, shape (1, 1): of all values that it has there, the one nearest to −1 or beyond."""
        return np.array([[float(np.min(self.at_infinity))]])

    @property
    def _turns(self) -> bool:
        """Whether L turns up to infinite frequency: a way without a state goes through a delay."""
        ends = self.at_infinity
        return bool(np.max(np.abs(ends - ends[0])) > ROUNDOFF * len(self.tau) * np.max(np.abs(ends)))

    @cached_property
    def _beyond(self) -> tuple[float, float]:
        """Frequency from which L is what it is at infinite frequency, and the size of what is left of it there.

        Without states L would be L(E), E = diag(e^(−sτ)). The difference falls as 1/ω; its factor is measured.
        """
        if not self._turns:
            return np.inf, 0.0
        parts = [*self.open.delayed, *self.close().delayed]
        sizes = [*np.abs(self.open.plain_poles), *(p.bound for p in parts if p.gain_at_infinity < 1.0)]
        at = 30.0 * (float(max(sizes, default=0.0)) or 1.0 / float(np.sum(self.tau)))
        omega = at * (1.0 + np.linspace(0.0, 1.0, SAMPLES) ** 2)
        r, m = self.rest, len(self.tau)
        E = np.exp(-1j * omega[:, None] * self.tau)
        into = np.linalg.solve(np.eye(m) - r.D[1:, 1:] * E[:, None, :], np.broadcast_to(r.D[1:, :1], (SAMPLES, m, 1)))
        ends = r.D[0, 0] + np.sum(r.D[0, 1:] * E * into[:, :, 0], axis=1)
        factor = float(np.max(np.abs(self.matrix(1j * omega)[:, 0, 0] - ends) * omega))
        size = min(float(np.max(np.abs(self.at_infinity))), float(np.min(np.abs(1.0 + self.at_infinity))))
        settled = max(at, factor / (SETTLED * max(size, 1e-300)))
        settled = min(settled, max(at, 2.0 * np.pi * MOST_CYCLES / float(np.sum(self.tau))))
        return settled, factor / settled

    @property
    def late(self) -> float:
        """Delay in s by which L turns at most, not counting the turns that its poles and zeros make."""
        return float(np.sum(self.tau))

    @property
    def settled(self) -> float:
        """Frequency in rad/s from which L is what it is at infinite frequency, but turns without end; else infinite."""
        return self._beyond[0]

    @property
    def end_error(self) -> float:
        """Relative error of L at infinite frequency where it turns, as a limit of values beyond `settled`.

        A real L(E) is one of real E, whose change with 1/ω is imaginary: the size changes with its square.
        """
        if not self._turns:
            return 1e-15
        left = self._beyond[1] / max(float(np.max(np.abs(self.at_infinity))), 1e-300)
        return max(1e-15, SECOND * left**2)

    @property
    def scale(self) -> float:
        """Size of the matrices."""
        return self.rest.scale

    @property
    def rounding_scale(self) -> float:
        """Size to which the rounding of the poles is relative."""
        return self.rest.rounding_scale

    # --- response -----------------------------------------------------------------------------------------------------

    def _equations(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return M, b and c of L = D + c M⁻¹ b at points, and M's derivative."""
        r, n, m = self.rest, self.rest.order, len(self.tau)
        E = np.exp(-s[:, None] * self.tau)
        M, slope = np.zeros((2, len(s), n + m, n + m), dtype=complex)
        M[:, :n, :n], M[:, :n, n:] = s[:, None, None] * np.eye(n) - r.A, -r.B[:, 1:] * E[:, None, :]
        M[:, n:, :n], M[:, n:, n:] = -r.C[1:], np.eye(m) - r.D[1:, 1:] * E[:, None, :]
        late = -self.tau * E
        slope[:, :n, :n], slope[:, :n, n:] = np.eye(n), -r.B[:, 1:] * late[:, None, :]
        slope[:, n:, n:] = -r.D[1:, 1:] * late[:, None, :]
        b = np.append(r.B[:, 0], r.D[1:, 0]).astype(complex)
        c = np.hstack([np.broadcast_to(r.C[0], (len(s), n)), r.D[0, 1:] * E])
        return M, slope, b, c

    def matrix(self, s: np.ndarray) -> np.ndarray:
        """Return L at points, shape (points, 1, 1)."""
        s = np.atleast_1d(np.asarray(s, dtype=complex))
        M, _, b, c = self._equations(s)
        v = np.linalg.solve(M, np.broadcast_to(b[:, None], (len(s), len(b), 1)))[:, :, 0]
        return np.asarray((self.rest.D[0, 0] + np.sum(c * v, axis=1))[:, None, None])

    def values(self, s: np.ndarray, slope: complex = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """Return L and ``slope`` times dL/ds at points."""
        s = np.asarray(s, dtype=complex)
        M, rate, b, c = self._equations(s)
        v = np.linalg.solve(M, np.broadcast_to(b[:, None], (len(s), len(b), 1)))
        moved = np.linalg.solve(M, rate @ v)[:, :, 0]
        late = c.copy()
        late[:, : self.rest.order] = 0.0
        late[:, self.rest.order :] *= -self.tau
        L = self.rest.D[0, 0] + np.sum(c * v[:, :, 0], axis=1)
        return np.asarray(L), np.asarray(slope * (np.sum(late * v[:, :, 0], axis=1) - np.sum(c * moved, axis=1)))

    def error(self, omega: float) -> float:
        """Return an estimate of the relative error of L at ω: the difference to the adjoint solution."""
        M, _, b, c = self._equations(np.array([1j * omega]))
        v, y = np.linalg.solve(M[0], b), np.linalg.solve(M[0].T, c[0])
        direct, adjoint = self.rest.D[0, 0] + c[0] @ v, self.rest.D[0, 0] + y @ b
        given = 0.0
        if self.inexactness:
            moved = float(np.abs(y) @ np.abs(M[0]) @ np.abs(v) + np.abs(y) @ np.abs(b) + np.abs(c[0]) @ np.abs(v))
            given = self.inexactness * moved / (abs(direct) + 1e-300)
        turned = 1e-15 * omega * float(np.max(self.tau, initial=0.0))  # of the angle ω τ
        return float(given + turned + 1e-13 + 10 * abs(direct - adjoint) / (abs(direct) + 1e-300))

    def rounding(self, s: np.ndarray) -> np.ndarray:
        """Return a bound of the rounding error of L at points; see `Realization.rounding`."""
        M, _, b, c = self._equations(np.asarray(s, dtype=complex))
        v = np.linalg.solve(M, np.broadcast_to(b[:, None], (len(M), len(b), 1)))[:, :, 0]
        y = np.linalg.solve(np.swapaxes(M, 1, 2), c[:, :, None])[:, :, 0]
        size = np.linalg.norm(M, axis=(1, 2)) * len(b)
        return np.asarray(ROUNDOFF * size * np.linalg.norm(v, axis=1) * np.linalg.norm(y, axis=1))

    # --- closed loop --------------------------------------------------------------------------------------------------

    @cached_property
    def open(self) -> DelayMatrices:
        """The characteristic function's matrices of the open loop."""
        r = self.rest
        return DelayMatrices(r.A, r.B[:, 1:], r.C[1:], r.D[1:, 1:], self.tau)

    def close(self, factor: complex = 1.0) -> DelayMatrices:
        """Return the characteristic function's matrices of the closed loop, L multiplied by a factor."""
        r = self.rest
        K = factor / (1.0 + r.D[0, 0] * factor)
        K = K.real if isinstance(K, complex) and K.imag == 0.0 else K
        into, out = np.vstack([r.B[:, :1], r.D[1:, :1]]), np.hstack([r.C[:1], r.D[:1, 1:]])
        whole = np.block([[r.A, r.B[:, 1:]], [r.C[1:], r.D[1:, 1:]]]) - K * into @ out
        n = r.order
        return DelayMatrices(whole[:n, :n], whole[:n, n:], whole[n:, :n], whole[n:, n:], self.tau)

    def put_late(self, tau: float) -> DelayedRealization:
        """Return the loop with a further delay in series."""
        r = self.rest
        n, m = r.order, len(self.tau)
        B = np.hstack([r.B, np.zeros((n, 1))])
        C = np.vstack([np.zeros((1, n)), r.C[1:], r.C[:1]])
        D = np.zeros((m + 2, m + 2))
        D[1 : m + 1, : m + 1], D[m + 1, : m + 1], D[0, m + 1] = r.D[1:], r.D[0], 1.0
        rest = Realization(r.A, B, C, D, 0.0, r.hidden, None, r.inexactness, r.hidden_errors, r.turned)
        return DelayedRealization(rest, np.append(self.tau, tau), self.hidden, self.hidden_errors, self.name)

    def count_unstable(self, factor: complex = 1.0) -> float:
        """Return the number of closed-loop poles that are not stable; see `DelayMatrices.count_unstable`."""
        if abs(1.0 + self.rest.D[0, 0] * factor) < 1e-12:
            return np.inf
        return self.close(factor).count_unstable()

    def find_marginal(self) -> np.ndarray:
        """Return the closed-loop poles that are on the limit of stability, up to rounding."""
        system = self.close()
        late = [part.near_axis[np.abs(part.near_axis.real) <= MARGINAL * part.bound] for part in system.delayed]
        plain = system.plain_poles
        on_it = np.abs(plain.real) <= 1e-13 * float(np.abs(plain).max(initial=0.0))
        return np.concatenate([plain[on_it], *late])

    def eigenvalues(self, factor: complex = 1.0) -> np.ndarray:
        """Return the rightmost closed-loop poles."""
        return np.array(sort_rightmost(_poles_of(self.close(factor)))[:SHOWN], dtype=complex)

    @cached_property
    def _plain(self) -> tuple[tuple[AxisPole, ...], np.ndarray]:
        """Poles of L in parts without delays: those on the limit of stability, and the others."""
        poles = self.open.plain_poles
        return split_axis_poles(self, poles, max(self.rounding_scale, float(np.abs(poles).max(initial=0.0))))

    @cached_property
    def features(self) -> Features:
        """Poles, zeros and closed-loop poles, as far as they shape the response."""
        axis, poles = self._plain
        more, off = list[AxisPole](), list[complex]()
        for part in self.open.delayed:
            limit = MARGINAL * part.bound
            off += [p for p in part.roots if abs(p.real) > limit]
            on = [p for p in part.roots if abs(p.real) <= limit and p.imag >= -limit]
            more += [AxisPole(p.imag if p.imag > limit else 0.0, 1, 1e-15 * part.bound) for p in on]
        zeros = self._zeros()
        axis_zeros, zeros = split_axis_poles(self, zeros, max(self.scale, float(np.abs(zeros).max(initial=0.0))))
        return Features(
            tuple(sorted((*axis, *more), key=lambda a: a.omega)),
            np.append(poles, off),
            axis_zeros,
            np.append(zeros, -np.pi / self.tau),  # a delay bends the response, too
            np.array(_poles_of(self.close()), dtype=complex),
        )

    def _zeros(self) -> np.ndarray:
        """Return the zeros with Padé's approximation in place of the delays."""
        from control import ss

        from .delayed_system import DelayedSystem

        r = self.rest
        rest = ss(r.A, r.B, r.C, r.D, 0, remove_useless_states=False)
        return Realization.of(DelayedSystem(rest, self.tau).pade(ZEROS_ORDER)).zeros()

    def count_open(self) -> float:
        """Return the number of poles of L beyond the limit of stability; those on it are not counted."""
        late = sum(p.count_unstable() - np.sum(np.abs(p.roots.real) <= MARGINAL * p.bound) for p in self.open.delayed)
        return float(np.sum(self._plain[1].real > 0) + late)

    def grid(self, low: float, high: float, count: int) -> np.ndarray:
        """Return frequencies in rad/s to draw a response at: ``count`` over the logarithm, and some for each turn."""
        step = 0.1 / float(np.sum(self.tau))
        turns = low + step * np.arange(min(MOST_TURNS, max(0, int((high - low) / step))))
        return np.unique(np.concatenate([np.geomspace(low, high, count), turns]))


def _poles_of(system: DelayMatrices) -> list[complex]:
    return [complex(p) for p in (*system.plain_poles, *(p for part in system.delayed for p in part.roots))]


def realize(loop: Any, *, delay: int = 0) -> Realization | DelayedRealization:
    """Return the realization of a loop, with delays or without."""
    # a loop itself is not asked, as it would look for near names; a linear model of a diagram has delays, and no inputs
    own = {*getattr(loop, "__dict__", ()), *dir(type(loop))}
    if {"delays", "ninputs"} <= own:
        return DelayedRealization.of(loop, delay=delay)
    return Realization.of(loop, delay=delay)
