"""Linear systems with delays: matrices of the rest, with the delays closed around it; its response and its roots.

ẋ = A x + B u + G w, z = C₂ x + D₂ u + H w, y = C x + D u + D₁ w with wᵢ(t) = zᵢ(t − τᵢ), a linear fractional form. At a
point s it is a system of linear equations with E = diag(e^(−s τᵢ)). Its characteristic function is

    f(s) = det(s I − A − G E (I − H E)⁻¹ C₂),

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
from ...blocks.library import PadeDelay
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
RIGHT = 0.01
"""Error of Padé's approximation, in parts of its input, up to which it is called right."""
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
    """A system with delays and without inputs: the matrices A, G, C₂ and H, and the delays in s."""

    A: np.ndarray
    G: np.ndarray
    C: np.ndarray
    H: np.ndarray
    tau: np.ndarray

    @cached_property
    def parts(self) -> list[DecoupledPart]:
        """The strongly connected parts; the characteristic function is the product of theirs."""
        from scipy.sparse.csgraph import connected_components

        n, whole = len(self.A), np.block([[self.A, self.G], [self.C, self.H]])
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
            self.A[np.ix_(x, x)], self.G[np.ix_(x, w)], self.C[np.ix_(w, x)], self.H[np.ix_(w, w)], self.tau[w]
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
        """Bound of |s| of all roots beyond the limit: the spectral radius of |A| + |G| (I − |H|)⁻¹ |C|.

        Where ways without a state have a gain of 1 or more there is none; then it is the size within which roots are
        searched.
        """
        if not len(self.A):
            return 0.0
        A, G, C, H = (np.abs(M) for M in (self.A, self.G, self.C, self.H))
        if not len(self.tau):
            return float(np.max(np.abs(np.linalg.eigvals(A))))
        if np.max(np.abs(np.linalg.eigvals(H)), initial=0.0) < 1.0:
            return float(np.max(np.abs(np.linalg.eigvals(A + G @ np.linalg.solve(np.eye(len(H)) - H, C)))))
        mu, d = mu_scaling(self.H.astype(complex))
        left = 1.0 - mu if mu < NEUTRAL else LEFT
        return float(np.linalg.norm(A, 2) + np.linalg.norm(G / d, 2) * np.linalg.norm(d[:, None] * C, 2) / left)

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
        gain = np.max(np.abs(np.linalg.eigvals(self.H + self.C @ rest @ self.G)), axis=1)
        chain = np.log(np.maximum(gain, 1e-300)) / tau + 1j * omega
        return self._search(np.concatenate([self.starts, chain, chain.conj()]))

    def evaluate(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return s I − A − G E (I − H E)⁻¹ C at points, and its derivative by s."""
        n, m = len(self.A), len(self.tau)
        s = np.asarray(s, dtype=complex)
        eye = np.eye(n)
        if not m:
            return s[:, None, None] * eye - self.A, np.broadcast_to(eye, (len(s), n, n)).astype(complex)
        E = np.exp(-s[:, None] * self.tau)
        X = np.linalg.inv(np.eye(m) - self.H * E[:, None, :])
        GE = self.G * E[:, None, :]
        XC = X @ self.C
        value = s[:, None, None] * eye - self.A - GE @ XC
        # d(E X)/ds = (I + E X H) (−τ E) X
        inner = self.tau[:, None] * E[:, :, None] * XC
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
        none = np.zeros((len(self.A), 0)), np.zeros((0, len(self.A))), np.zeros((0, 0))
        empty = np.zeros((0, len(self.tau))), np.zeros((len(self.tau), 0))
        try:
            rest = self.A, *none, self.G, self.C, self.H, *empty
            return np.linalg.eigvals(replace_delays(*rest, self.tau, orders)[0])
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
            all(np.isrealobj(M) or not np.any(np.imag(M)) for M in (self.A, self.G, self.C, self.H)),
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


def replace_delays(
    A: np.ndarray,
    B: np.ndarray,
    C: np.ndarray,
    D: np.ndarray,
    G: np.ndarray,
    Z: np.ndarray,
    H: np.ndarray,
    E: np.ndarray,
    F: np.ndarray,
    tau: np.ndarray,
    orders: Sequence[int],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return A, B, C and D with Padé's approximations of the delays, of some orders, behind the states.

    The system is ẋ = A x + B u + G w, z = Z x + F u + H w, y = C x + D u + E w. Numbers may be complex, with slopes.

    Raises `LinAlgError` if a way around the delays without a state has no unique solution.
    """
    m, q = len(tau), sum(orders)
    kind = np.result_type(A, G, tau)
    Ap, Bp, Cp, Dp = (np.zeros(shape, dtype=kind) for shape in ((q, q), (q, m), (m, q), (m, m)))
    begin = 0
    for i, (time, order) in enumerate(zip(tau, orders, strict=True)):
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
    rest = none, column, row, empty, column, row, empty, one, one
    A, B, C, D = replace_delays(*rest, np.ones(1), [order])
    x = np.geomspace(0.01, 4.0 * order + 4.0, 4000)
    made = np.array([(C @ np.linalg.solve(1j * w * np.eye(order) - A, B) + D)[0, 0] for w in x])
    return float(x[int(np.argmax(np.abs(made - np.exp(-1j * x)) > RIGHT))])


def replace_conjugate(system: DelayMatrices) -> DelayMatrices:
    """Return the system with conjugate matrices, whose roots are the conjugate ones."""
    return replace(system, **{name: np.conj(getattr(system, name)) for name in "AGCH"})


def sort_rightmost(roots: Sequence[complex]) -> tuple[complex, ...]:
    """Return roots with the rightmost first; of a pair the lower one first."""
    return tuple(sorted((complex(p) for p in roots), key=lambda p: (-p.real, abs(p.imag), p.imag)))
