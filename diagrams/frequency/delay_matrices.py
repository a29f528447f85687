"""Poles of linear systems with delays (`LinearDelays`): roots of a characteristic function, and their number.

With E = diag(e^(−s τᵢ)) it is

    f(s) = det(s I − A − G E (I − H E)⁻¹ Z),

of which every root beyond the limit of stability is counted by the argument along the axis (Mikhailov's criterion; Gu,
Kharitonov and Chen, Stability of Time-Delay Systems, 2003). Padé's approximation is no part of that: its poles only say
around which frequencies the function is evaluated more closely, and Newton's method starts from them.

Around the delays there may be a way without a state (H has a cycle): a neutral system. It is stable only if that way's
gain is below 1, for every choice of the delays (strong stability; Hale and Verduyn Lunel, 2002): with several delays,
if the structured singular value of H is. Then all roots beyond the limit lie within a bound.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ...blocks.core import ConfirmationError
from .linear_delays import LinearDelays
from .structured_value import mu_bound, mu_scaling

MARGINAL = 1e-11
"""Distance of a root from the axis, relative to the bound of all roots, within which it is on the axis."""
FAR = 4.0
"""Frequency, in parts of the bound of all roots, up to which the argument is followed."""
TURN = 0.6
"""Largest turn in rad from one point to the next while the argument is followed."""
BEND = 0.3
"""Largest difference in rad between such a turn and that of the slopes at both ends."""
MOST_POINTS = 200_000
"""Points after which the argument is given up."""
NEAR = 0.1
"""Damping ratio of Padé's poles below which roots are searched to tell on which side of the axis they are."""
NEUTRAL = 1.0 - 1e-12
"""Gain of the ways around the delays without a state from which on infinitely many roots are not stable."""
LEFT = 0.1
"""Distance of such a gain from 1 that takes its place in the size within which roots are then searched."""
MOST_ROOTS = 1000
"""Roots beyond the limit up to which all are looked for."""
CHAIN = 4.0
"""Starts of searches for each of them, a quarter of their distance apart in a chain."""
NEWTON = 60
"""Steps of Newton's method."""
SIDES = np.array([-30, -10, -3, -1, -0.3, 0.0, 0.3, 1, 3, 10, 30])
"""Distances from a root, in parts of its distance from the axis, at which the argument is looked at."""


class DecoupledPart(NamedTuple):
    """States and delays that all act on one another, of a system with delays."""

    states: np.ndarray
    delays: np.ndarray


@dataclass(frozen=True, eq=False)
class DelayMatrices:
    """The matrices of a system with delays of which its poles depend, and the delays in s; see `LinearDelays`."""

    A: np.ndarray
    G: np.ndarray
    Z: np.ndarray
    H: np.ndarray
    tau: np.ndarray

    @classmethod
    def of(cls, A: np.ndarray, late: LinearDelays | None) -> DelayMatrices:
        """Return those of the system with this A and these delays; None are no delays."""
        if late is None:
            return cls(A, np.zeros((len(A), 0)), np.zeros((0, len(A))), np.zeros((0, 0)), np.zeros(0))
        return cls(A, late.G, late.Z, late.H, late.times)

    @cached_property
    def parts(self) -> list[DecoupledPart]:
        """The strongly connected parts; the characteristic function is the product of theirs."""
        from scipy.sparse.csgraph import connected_components

        n, whole = len(self.A), np.block([[self.A, self.G], [self.Z, self.H]])
        count, labels = connected_components(whole != 0.0, directed=True, connection="strong")
        found = []
        for k in range(count):
            members = np.flatnonzero(labels == k)
            found.append(DecoupledPart(members[members < n], members[members >= n] - n))
        return found

    def take(self, part: DecoupledPart) -> DelayMatrices:
        """Return the matrices of a part alone."""
        x, w = part
        return DelayMatrices(
            self.A[np.ix_(x, x)], self.G[np.ix_(x, w)], self.Z[np.ix_(w, x)], self.H[np.ix_(w, w)], self.tau[w]
        )

    @cached_property
    def delayed(self) -> list[DelayMatrices]:
        """The parts with a delay that acts back on itself."""
        return [
            self.take(p)
            for p in self.parts
            if len(p.delays) and (len(p.states) or self.H[np.ix_(p.delays, p.delays)].any())
        ]

    @cached_property
    def plain_poles(self) -> np.ndarray:
        """The poles of the parts without delays."""
        found = [np.linalg.eigvals(self.take(p).A) for p in self.parts if not len(p.delays)]
        return np.concatenate([np.zeros(0, dtype=complex), *found])

    @cached_property
    def gain_at_infinity(self) -> float:
        """Gain of the ways around the delays without a state: the neutral part is stable below 1."""
        return max((mu_bound(self.H[np.ix_(w, w)].astype(complex)) for w in self.cycles), default=0.0)

    @cached_property
    def cycles(self) -> list[np.ndarray]:
        """Delays that act on one another, or on themselves, by ways without a state: the places of each set."""
        from scipy.sparse.csgraph import connected_components

        if not self.H.any():
            return []
        count, labels = connected_components(self.H != 0.0, directed=True, connection="strong")
        sets = [np.flatnonzero(labels == k) for k in range(count)]
        return [w for w in sets if self.H[np.ix_(w, w)].any()]

    @cached_property
    def chains(self) -> float:
        """Largest Re s, in 1/s, of the chains of roots that the ways without a state have up to infinite frequency.

        With one delay it is ln|h|/τ, which the chain's roots approach; with several delays their largest for every
        choice of the delays' ratios. It is −∞ without such ways.
        """
        return max((_find_chain(self.H[np.ix_(w, w)], self.tau[w]) for w in self.cycles), default=-math.inf)

    @cached_property
    def bound(self) -> float:
        """Bound of |s| of all roots beyond the limit: the spectral radius of |A| + |G| (I − |H|)⁻¹ |Z|.

        Where ways without a state have a gain of 1 or more there is none; then it is the size within which roots are
        searched.
        """
        if not len(self.A):
            return 0.0
        A, G, Z, H = (np.abs(M) for M in (self.A, self.G, self.Z, self.H))
        if not len(self.tau):
            return float(np.max(np.abs(np.linalg.eigvals(A))))
        if np.max(np.abs(np.linalg.eigvals(H)), initial=0.0) < 1.0:
            return float(np.max(np.abs(np.linalg.eigvals(A + G @ np.linalg.solve(np.eye(len(H)) - H, Z)))))
        mu, d = mu_scaling(self.H.astype(complex))
        left = 1.0 - mu if mu < NEUTRAL else LEFT
        return float(np.linalg.norm(A, 2) + np.linalg.norm(G / d, 2) * np.linalg.norm(d[:, None] * Z, 2) / left)

    def poles(self) -> tuple[complex, ...]:
        """Return the poles without those far to the left, the rightmost first; all that are not stable are among them.

        Where ways without a state have a gain of 1 or more, infinitely many are not stable, and some are returned.

        Raises `ConfirmationError` if fewer were found than the argument says, or more.
        """
        found = self.plain_poles.tolist()
        for part in self.delayed:
            if part.gain_at_infinity >= NEUTRAL:
                found += part.roots.tolist()
                continue
            roots, count = part.roots, part.count_in_part()
            if count > part.count_beyond(roots):
                roots = part.find_chain(count)
            if count > part.count_beyond(roots):
                raise ConfirmationError(
                    f"found {len(roots)} roots of a characteristic function, of which fewer than {count:g} are "
                    "not stable; expected that many. The system is far from stable: count_unstable() counts them.",
                    block="delays",
                )
            found += roots.tolist()
        return sort_rightmost(found)

    def count_beyond(self, roots: np.ndarray) -> int:
        """Return how many of some roots are not stable."""
        return int(np.sum(roots.real >= -MARGINAL * self.bound))

    def find_chain(self, count: float) -> np.ndarray:
        """Return the roots from more starts, of which ``count`` are not stable, the rightmost first.

        Behind a delay τ that is long, with a gain g(ω) around it, there is a chain of them about 2π/τ apart, near
        s = ln(g)/τ + i ω. Of more than `MOST_ROOTS` those that are known are returned.
        """
        if count > MOST_ROOTS:
            return self.roots
        tau = float(np.max(self.tau))
        omega = np.pi / (2.0 * tau) * np.arange(1, round(CHAIN * count) + 1)
        rest = np.linalg.inv(1j * omega[:, None, None] * np.eye(len(self.A)) - self.A)
        gain = np.max(np.abs(np.linalg.eigvals(self.H + self.Z @ rest @ self.G)), axis=1)
        chain = np.log(np.maximum(gain, 1e-300)) / tau + 1j * omega
        return self._search(np.concatenate([self.starts, chain, chain.conj()]))

    def evaluate(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return s I − A − G E (I − H E)⁻¹ Z at points, and its derivative by s."""
        n, m = len(self.A), len(self.tau)
        s = np.asarray(s, dtype=complex)
        eye = np.eye(n)
        if not m:
            return s[:, None, None] * eye - self.A, np.broadcast_to(eye, (len(s), n, n)).astype(complex)
        E = np.exp(-s[:, None] * self.tau)
        X = np.linalg.inv(np.eye(m) - self.H * E[:, None, :])
        GE = self.G * E[:, None, :]
        XZ = X @ self.Z
        value = s[:, None, None] * eye - self.A - GE @ XZ
        # d(E X)/ds = (I + E X H) (−τ E) X
        inner = self.tau[:, None] * E[:, :, None] * XZ
        slope = eye + (self.G + GE @ X @ self.H) @ inner
        return value, slope

    def log_slope(self, s: np.ndarray) -> np.ndarray:
        """Return f'/f at points."""
        value, slope = self.evaluate(s)
        return np.asarray(np.trace(np.linalg.solve(value, slope), axis1=1, axis2=2))

    def approximate_poles(self) -> np.ndarray:
        """Return the poles with the delays replaced by Padé's approximation: starts of searches, never results."""
        if not len(self.A):
            return np.zeros(0, dtype=complex)
        orders = [int(np.clip(np.ceil(self.bound * tau) + 6, 8, 24)) for tau in self.tau]
        n, m = len(self.A), len(self.tau)
        without_ports = self.A, np.zeros((n, 0)), np.zeros((0, n)), np.zeros((0, 0))
        late = LinearDelays((), self.tau, self.G, self.Z, self.H, E=np.zeros((0, m)), F=np.zeros((m, 0)))
        try:
            return np.linalg.eigvals(late.approximate(without_ports, orders)[0])
        except np.linalg.LinAlgError:
            return np.zeros(0, dtype=complex)

    @cached_property
    def starts(self) -> np.ndarray:
        """Poles of Padé's approximation up to the frequency to which the argument is followed."""
        found = self.approximate_poles()
        return np.asarray(found[np.abs(found) <= 4.0 * FAR * self.bound], dtype=complex)

    @cached_property
    def roots(self) -> np.ndarray:
        """Roots that Newton's method finds from the poles of Padé's approximation, the rightmost first.

        There are infinitely many, of which those far to the left are not found.
        """
        return self._search(self.starts)

    @cached_property
    def near_axis(self) -> np.ndarray:
        """Those of the roots that are near the axis, or beyond it."""
        return self._search(self.starts[self.starts.real > -NEAR * (np.abs(self.starts) + 1e-3 * self.bound)])

    def _search(self, starts: np.ndarray) -> np.ndarray:
        """Return the different roots that Newton's method finds, the rightmost first."""
        s, alive = starts.astype(complex), np.ones(len(starts), dtype=bool)
        done = np.zeros(len(starts), dtype=bool)
        with np.errstate(all="ignore"):
            for _ in range(NEWTON):
                todo = np.flatnonzero(alive & ~done)
                if not todo.size:
                    break
                try:
                    step = 1.0 / self.log_slope(s[todo])
                except np.linalg.LinAlgError:  # one of them is a root to the last digit
                    step = np.array([self._step(at) for at in s[todo]])
                alive[todo] &= np.isfinite(step)
                s[todo] = np.where(np.isfinite(step), s[todo] - step, s[todo])
                alive[todo] &= np.abs(s[todo] - starts[todo]) < 2.0 * (1.0 + np.abs(starts[todo])) + self.bound
                done[todo] = np.abs(step) <= 1e-13 * (np.abs(s[todo]) + 1e-3 * self.bound)
        all_found = s[alive & done]
        found = np.full(len(all_found), np.inf, dtype=complex)
        count = 0
        for root in all_found:
            if np.all(np.abs(root - found[:count]) > 1e-8 * (abs(root) + 1e-3 * self.bound)):
                found[count], count = root, count + 1
        return np.array(sort_rightmost(found[:count].tolist()), dtype=complex)

    def _step(self, at: complex) -> complex:
        try:
            return complex(1.0 / self.log_slope(np.array([at]))[0])
        except np.linalg.LinAlgError:
            return 0j

    def count_unstable(self) -> float:
        """Return the number of roots that are not stable; infinite where ways without a state have a gain of 1 or more.

        A root on the axis, up to rounding, counts, as do poles of parts without delays.

        Raises `ConfirmationError` if the argument can't be followed, or a root is found where it says that there is
        none.
        """
        if self.gain_at_infinity >= NEUTRAL:
            return math.inf
        plain = self.plain_poles
        rounding = 1e-13 * float(np.abs(plain).max(initial=0.0))
        return float(np.sum(plain.real >= -rounding)) + sum(part.count_in_part() for part in self.delayed)

    def count_in_part(self) -> float:
        """Return the number of roots of a connected part that are not stable."""
        if not len(self.A):
            return 0.0
        found = self.near_axis
        limit = MARGINAL * self.bound
        beyond = int(np.sum(found.real >= -limit))
        if np.any(np.abs(found.real) <= limit):
            return float(beyond)
        count = self.count_by_argument()
        if beyond > count:
            raise ConfirmationError(
                f"found {beyond} roots of the characteristic function beyond the limit of stability, the first at "
                f"{found[0]:.6g}, but its argument along the axis says {count}; expected the same. Scale the diagram's "
                "signals to similar sizes.",
                block="delays",
            )
        return float(count)

    def count_by_argument(self) -> int:
        """Return the number of roots beyond the axis, by the argument of f along it."""
        n, is_real = (
            len(self.A),
            all(np.isrealobj(M) or not np.any(np.imag(M)) for M in (self.A, self.G, self.Z, self.H)),
        )
        upper = self._turn()
        lower = upper if is_real else replace_conjugate(self)._turn()
        count = 0.5 * n - (upper + lower) / (2.0 * np.pi)
        if abs(count - round(count)) > 1e-3:
            raise ConfirmationError(
                f"found {count:.6f} roots beyond the limit of stability by the argument of the characteristic "
                "function; expected a whole number. A root may lie on the limit: change a gain by a little.",
                block="delays",
            )
        return round(count)

    def _turn(self) -> float:
        """Return by how much the argument of f grows from s = 0 to infinity along the positive axis, in rad."""
        top = FAR * self.bound
        near = np.concatenate([self.near_axis, self.starts])
        around = [np.abs(near.imag) + np.abs(near.real) * side for side in SIDES]
        omega = np.concatenate([[0.0], np.geomspace(1e-6 * top, top, 100), *around])
        omega = np.unique(omega[(omega >= 0.0) & (omega <= top)])
        turn, rate = self._look(omega)
        while True:
            step, h = np.angle(turn[1:] / turn[:-1]), np.diff(omega)
            even = np.abs(step - 0.5 * h * (rate[1:] + rate[:-1])) < BEND
            slow = (np.abs(h * rate[1:]) < 2.0 * TURN) & (np.abs(h * rate[:-1]) < 2.0 * TURN)
            coarse = ~(even & slow & (np.abs(step) < TURN)) & (h > 1e-14 * top)
            if not coarse.any():
                break
            if len(omega) > MOST_POINTS:
                raise ConfirmationError(
                    f"found a characteristic function that still turns at {len(omega)} frequencies; expected fewer. "
                    "The delays are long for the fastest state: leave that state out, or take .pade(order).",
                    block="delays",
                )
            between, after = 0.5 * (omega[1:] + omega[:-1])[coarse], np.flatnonzero(coarse) + 1
            more, slopes = self._look(between)
            omega, turn, rate = (np.insert(a, after, b) for a, b in ((omega, between), (turn, more), (rate, slopes)))
        value, _ = self.evaluate(1j * omega[-1:])
        rest = np.log(np.linalg.eigvals(value[0]) / (1j * omega[-1])).imag.sum()  # what is left up to infinity
        return float(np.sum(np.angle(turn[1:] / turn[:-1])) - rest)

    def _look(self, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return f/|f| at frequencies, and the slope of its argument."""
        turns, rates = [np.zeros(0, dtype=complex)], [np.zeros(0)]
        for some in np.array_split(omega, max(1, len(omega) // 4096)):
            value, slope = self.evaluate(1j * some)
            sign, _ = np.linalg.slogdet(value)
            if np.any(sign == 0):
                raise ConfirmationError(
                    "found a root of the characteristic function on the axis; expected none. Change a gain a little.",
                    block="delays",
                )
            turns.append(sign)
            rates.append(np.trace(np.linalg.solve(value, slope), axis1=1, axis2=2).real)
        return np.concatenate(turns), np.concatenate(rates)


def _find_chain(H: np.ndarray, tau: np.ndarray) -> float:
    """Return the Re s at which the ways without a state have the gain 1 with signals that grow as e^(s t)."""
    from scipy.optimize import brentq

    def above(c: float) -> float:
        return math.log(max(mu_bound(H * np.exp(-c * tau).astype(complex)), 1e-300))

    if len(tau) == 1:
        return math.log(abs(complex(H[0, 0]))) / float(tau[0])
    mu = math.log(max(mu_bound(H.astype(complex)), 1e-300))
    ends = sorted((mu / float(np.max(tau)), mu / float(np.min(tau))))
    if above(ends[0]) <= 0.0 or above(ends[1]) >= 0.0:  # equal delays: both are the same, up to rounding
        return ends[0]
    return float(brentq(above, *ends, xtol=1e-13 * max(map(abs, ends)), rtol=1e-13))


def replace_conjugate(system: DelayMatrices) -> DelayMatrices:
    """Return the system with conjugate matrices, whose roots are the conjugate ones."""
    return replace(system, **{name: np.conj(getattr(system, name)) for name in "AGZH"})


def sort_rightmost(roots: Sequence[complex]) -> tuple[complex, ...]:
    """Return roots with the rightmost first; of a pair the lower one first."""
    return tuple(sorted((complex(p) for p in roots), key=lambda p: (-p.real, abs(p.imag), p.imag)))
