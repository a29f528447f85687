"""The indicators of events at several instants: in one call where the diagram allows it, else one after the other."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import casadi as ca
import numpy as np

from ...blocks.core import SimulationError
from ..flat import Bound, FlatDiagram, bind_function
from ..solvers import AcceptedStep

SIZES = (8, 16, 32, 64)
"""Instants in one call; results of those beyond the ones asked for are left."""
_MOST_SCANNED = 16
"""Most events that are scanned over a step in one call."""


class Instant(Protocol):
    """Vectors of an instant, in place."""

    x: np.ndarray
    w: np.ndarray
    p: np.ndarray


class Scan(NamedTuple):
    """The indicators over a step, one instant a row.

    ``open`` is 1 where the subsystem around an event is open. ``trouble`` is 0 if all values are finite, all subsystems
    open, no value but those at the first instant is outside of the bounds, and none is closer to zero than before and
    after. ``size`` are the largest absolute values, ``later`` those without the first instant.
    """

    z: np.ndarray
    open: np.ndarray
    trouble: float
    size: np.ndarray
    later: np.ndarray
    value: Callable[[float], np.ndarray]
    """The indicators at another time of the step, to rounding; valid until the next scan."""


class ManyInstants:
    """The indicators as one function of several instants: a call costs little more than one of a single instant.

    Parameters
    ----------
    flat : FlatDiagram
        The diagram; its indicators are one stage, without algebraic loops and transport delays.
    at : Instant
        The vectors that the entries of x beside the continuous states, w and p are taken from at each call.
    time_at : callable
        Returns the time in s that sources see at a time: another one at the ends of a step only.
    """

    def __init__(self, flat: FlatDiagram, at: Instant, time_at: Callable[[float], float]):
        self._function, self._x, self._w, self._p = flat.indicators.last.fast, at.x, at.w, at.p
        self._time_at, where = time_at, flat.continuous
        self._made: dict[tuple[int, int], tuple[Any, Any]] = flat.made["indicators of several instants"]
        together = where.size > 0 and where[-1] - where[0] == where.size - 1
        self._where: slice | np.ndarray = slice(int(where[0]), int(where[-1]) + 1) if together else where
        self._states, self._events = where.size, self._function.numel_out(0)
        self._others = where.size < at.x.size
        self._at_states: dict[int, tuple[Bound, list[np.ndarray]]] = {}
        self._in_step: dict[tuple[int, int], tuple[Bound, Bound, list[np.ndarray]]] = {}

    # --- at given states ---------------------------------------------------------------------------------------------

    def __call__(self, times: np.ndarray, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the indicators, one row an instant, and 1 where the subsystems around their events are open.

        Values are those of single calls, to the last bit.
        """
        n, most = len(times), SIZES[-1]
        if n > most:
            parts = [self(times[k : k + most], states[k : k + most]) for k in range(0, n, most)]
            return np.concatenate([z for z, _ in parts]), np.concatenate([opened for _, opened in parts])
        size = SIZES[bisect_left(SIZES, n)]
        if size not in self._at_states:
            self._at_states[size] = self._bind_states(size)
        bound, (t, x, z, opened) = self._at_states[size]
        self._put_times(times, t)
        if self._others:
            x[:n] = self._x
        x[:n, self._where] = states
        bound.call()
        return z[:n].copy(), opened[:n].copy()

    def _bind_states(self, size: int) -> tuple[Bound, list[np.ndarray]]:
        function = self._function.map(size, [False, False, True, True], [False, False])
        t, x = np.zeros(size), np.zeros((size, len(self._x)))
        z, opened = np.zeros((size, self._events)), np.zeros((size, self._events))
        bound = bind_function(function, [t, x.reshape(-1), self._w, self._p], [z.reshape(-1), opened.reshape(-1)])
        return bound, [t, x, z, opened]

    def _put_times(self, times: np.ndarray, into: np.ndarray) -> None:
        n = len(times)
        into[:n] = times
        for k in (0, n - 1) if n > 3 else range(n):
            into[k] = self._time_at(float(times[k]))

    # --- in a step ---------------------------------------------------------------------------------------------------

    @property
    def scans(self) -> bool:
        """Whether there are few enough events for `scan` to be worth its making."""
        return bool(self._events <= _MOST_SCANNED)

    def scan(self, step: AcceptedStep, times: np.ndarray, bounds: tuple[np.ndarray, np.ndarray]) -> Scan | None:
        """Return the indicators at instants of a step; None if its states are no polynomials.

        Parameters
        ----------
        step : AcceptedStep
            The step.
        times : ndarray, shape (n,)
            The instants in s, at most the largest one of `SIZES`.
        bounds : tuple of ndarray
            Least and largest value of each indicator for which nothing happens.
        """
        states = step.polynomial()
        if states is None:
            return None
        n, order = len(times), states.coefficients.shape[1]
        key = SIZES[bisect_left(SIZES, n)], order
        if key not in self._in_step:
            self._in_step[key] = self._bind_step(*key)
        bound, single, (t, u, start, coefficients, low, high, inner, t_one, u_one) = self._in_step[key]
        self._put_times(times, t)
        t[n:] = t[n - 1]
        np.subtract(times, states.t, out=u[:n])
        u[n:] = u[n - 1]
        u /= states.h
        start[:], coefficients[:] = states.x, states.coefficients.T
        low[:], high[:] = bounds
        inner[: n - 2], inner[n - 2 :] = 1.0, 0.0
        bound.call()
        z, opened, trouble, size, later = bound.outputs
        m, time_at, call, one = self._events, self._time_at, single.call, single.outputs[0]
        t_old, h = states.t, states.h
        found = float(trouble[0]) if math.isfinite(trouble[1]) else math.nan

        def value(time: float) -> np.ndarray:
            t_one[0], u_one[0] = time_at(time), (time - t_old) / h
            call()
            return one

        return Scan(z.reshape(-1, m)[:n], opened.reshape(-1, m)[:n], found, size.copy(), later, value)

    def _bind_step(self, n: int, order: int) -> tuple[Bound, Bound, list[np.ndarray]]:
        if (n, order) not in self._made:
            self._made[n, order] = self._make_scan(n, order)
        whole, one = self._made[n, order]
        m, k = self._events, self._states
        t, u, bounds, inner = np.zeros(n), np.zeros(n), (np.zeros(m), np.zeros(m)), np.zeros(n - 2)
        start, coefficients, at = np.zeros(k), np.zeros((order, k)), (np.zeros(1), np.zeros(1))
        shared = [start, coefficients.reshape(-1), self._x, self._w, self._p]
        single = bind_function(one, [*at, *shared])
        bound = bind_function(whole, [t, u, *shared, *bounds, inner])
        return bound, single, [t, u, start, coefficients, *bounds, inner, *at]

    def _make_scan(self, n: int, order: int) -> tuple[Any, Any]:
        """Return the function of `scan`, and that of a single instant."""
        m, function = self._events, self._function
        kind: Any = ca.SX if function.is_a("SXFunction") else ca.MX
        t, u, x = kind.sym("t"), kind.sym("u"), kind.sym("x", len(self._x))
        w, p = kind.sym("w", len(self._w)), kind.sym("p", len(self._p))
        start, coefficients = kind.sym("start", self._states), kind.sym("c", self._states, order)
        change = kind.zeros(self._states)
        for k in reversed(range(order)):
            change = (change + coefficients[:, k]) * u
        state = kind(x)
        state[np.arange(len(self._x))[self._where].tolist()] = start + change
        shared = [start, coefficients, x, w, p]
        one = ca.Function("indicators_in_step", [t, u, *shared], list(function.call([t, state, w, p])))

        symbols = [ca.MX.sym(f"v{k}", *one.size_in(k)) for k in range(2, one.n_in())]
        ts, us, low, high = ca.MX.sym("t", 1, n), ca.MX.sym("u", 1, n), ca.MX.sym("low", m), ca.MX.sym("high", m)
        inner = ca.MX.sym("inner", 1, n - 2)
        z, opened = one.map(n, [False, False, *[True] * len(shared)], [False, False]).call([ts, us, *symbols])
        size = ca.fabs(z)
        later = [ca.mmax(size[i, 1:]) for i in range(m)]
        largest = [ca.fmax(most, size[i, 0]) for i, most in enumerate(later)]
        outside = ca.logic_or(z[:, 1:] > ca.repmat(high, 1, n - 1), z[:, 1:] < ca.repmat(low, 1, n - 1))
        before, middle, after = size[:, :-2], size[:, 1:-1], size[:, 2:]
        near = ca.logic_and(ca.fmax(before, after) > middle, ca.fmin(before, after) >= middle) * ca.repmat(inner, m, 1)
        trouble = sum(ca.sum1(ca.sum2(part)) for part in (outside, near, opened <= 0.5))
        results = [z, opened, ca.vertcat(trouble, ca.sum1(ca.sum2(z))), ca.vertcat(*largest), ca.vertcat(*later)]
        whole = ca.Function("scan", [ts, us, *symbols, low, high, inner], [ca.densify(y) for y in results])
        return whole, one


def evaluate_many(
    g: Callable[[float, np.ndarray], np.ndarray], opened: np.ndarray, times: np.ndarray, states: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return indicators at several times, one row each, NaN beyond a failure, and what ``g`` writes into ``opened``."""
    n = len(opened)
    z, open_then = np.full((len(times), n), math.nan), np.ones((len(times), n))
    try:
        for k, t in enumerate(times.tolist()):
            z[k] = g(t, states[k])
            open_then[k] = opened
    except SimulationError:  # a loop without a solution: whoever needs that instant evaluates it again
        z[k:], open_then[k:] = math.nan, 1.0
    return z, open_then
