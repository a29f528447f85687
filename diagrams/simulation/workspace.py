"""The numbers of a run: its vectors, and a diagram's functions bound to them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ...blocks.core.errors import SimulationError
from ..flat.flat_diagram import FlatDiagram
from ..flat.functions import NONE, active_loops
from ..flat.layout import Clock

TOLERANCE = 1e-9
"""Largest residual of an algebraic loop that counts as solved, relative to 1 + the size of its values."""
_ITERATIONS = 50
_ROUNDING = 1e-14


class Vectors:
    """t, x and w: what all functions of a diagram are evaluated at."""

    def __init__(self, flat: FlatDiagram):
        self.t = np.zeros(1)
        self.x = flat.x0.copy()
        self.w = np.zeros(flat.plant_outputs.total)


class Bound:
    """A function with its results, bound to vectors: evaluated by a call, without a copy."""

    def __init__(self, function: Any, inputs: list[np.ndarray], outputs: list[np.ndarray] | None = None):
        self.buffer, self.call = function.buffer()
        if outputs is None:
            outputs = [np.zeros(function.numel_out(i)) for i in range(function.n_out())]
        self.outputs = outputs
        for i, vector in enumerate(inputs):
            self.buffer.set_arg(i, view(vector))
        for i, vector in enumerate(outputs):
            self.buffer.set_res(i, view(vector))


def view(vector: np.ndarray) -> Any:
    """Return the memory of a vector, as CasADi's buffers take it."""
    return memoryview(vector)  # type: ignore[arg-type]


class Machine:
    """A diagram's functions with the numbers of one run.

    ``here`` is the instant that the run has reached, ``trial`` the one that a solver tries.
    """

    def __init__(self, flat: FlatDiagram):
        self.flat = flat
        self.here, self.trial = Vectors(flat), Vectors(flat)
        self.x_next = np.zeros(flat.width)
        self.z = np.zeros(flat.plant_inputs.total)
        self.log = np.zeros(flat.log.total + flat.width + bool(flat.loops.slices))
        self.ok = np.zeros(1)
        self.looped = bool(flat.loops.slices)
        self._ticks: dict[frozenset[Clock], Callable[[], None]] = {}
        self._kept: list[Bound] = []
        self._loops: dict[Any, Any] = {}
        self._solved: dict[Any, Callable[[], None]] = {}

    def _bind(
        self, function: Any, vectors: Vectors, outputs: list[np.ndarray] | None = None, *more: np.ndarray
    ) -> Bound:
        arguments = [vectors.t, vectors.x, vectors.w, self.flat.p, *more]
        bound = Bound(self.flat.fast(function), arguments, outputs)
        self._kept.append(bound)  # the buffer lives as long as its call
        return bound

    def tick(self, acting: frozenset[Clock]) -> Callable[[], None]:
        """Return the call that evaluates a tick at ``here``: into x_next, z, log and ok."""
        if acting not in self._ticks:
            results = [self.x_next, self.z, self.log, self.ok]
            call = self._bind(self.flat.at_tick(acting), self.here, results).call
            solve = self.loop_solver(acting, self.here)
            self._ticks[acting] = call if solve is None else _one_after_the_other(solve, call)
        return self._ticks[acting]

    def look(self) -> None:
        """Evaluate everything at ``here`` between ticks."""
        self.tick(NONE)()

    def flow(self) -> Callable[[float, np.ndarray], np.ndarray]:
        """Return the rates of the continuous states, ``f(t, x)``; w is that of ``trial``."""
        return self._of_trial(self.flat.flow)

    def jacobian(self) -> Callable[[float, np.ndarray], np.ndarray]:
        """Return the derivative of `flow` by the continuous states, (n, n); through algebraic loops as well."""
        flat, trial, n = self.flat, self.trial, self.flat.continuous.size
        if not self.looped or self.loop_solver(NONE, trial) is None:
            call = self._of_trial(flat.jacobian)
            return lambda t, x: call(t, x).reshape(n, n, order="F")
        from ..flat.functions import flow_jacobian_with_loops

        bound = self._bind(flow_jacobian_with_loops(flat), trial)
        solve: Any = self.loop_solver(NONE, trial)
        m = len(active_loops(flat, NONE))

        def through(t: float, x: np.ndarray) -> np.ndarray:
            trial.t[0] = t
            trial.x[flat.continuous] = x
            solve()
            bound.call()
            fx, fv, rx, rv = bound.outputs
            slope = np.linalg.solve(rv.reshape(m, m, order="F"), rx.reshape(m, n, order="F"))
            return np.array(fx.reshape(n, n, order="F") - fv.reshape(n, m, order="F") @ slope)

        return through

    def indicators(self) -> tuple[Callable[[float, np.ndarray], np.ndarray], np.ndarray]:
        """Return ``g(t, x)`` of all events at ``trial``, and the array of which boxes are open then."""
        bound = self._bind(self.flat.indicators, self.trial)
        return self._trial_call(bound), bound.outputs[1]

    def _of_trial(self, function: Any) -> Callable[[float, np.ndarray], np.ndarray]:
        return self._trial_call(self._bind(function, self.trial))

    def _trial_call(self, bound: Bound) -> Callable[[float, np.ndarray], np.ndarray]:
        t, x, call, result = self.trial.t, self.trial.x, bound.call, bound.outputs[0]
        where, solve = self.flat.continuous, self.loop_solver(NONE, self.trial)

        def evaluate(time: float, state: np.ndarray) -> np.ndarray:
            t[0] = time
            x[where] = state
            if solve is not None:
                solve()
            call()
            return result

        return evaluate

    def jump(self) -> tuple[Callable[[], None], np.ndarray]:
        """Return the call that makes x_next of ``here``, and the array to fill with the events that fire."""
        fired = np.zeros(len(self.flat.events))
        call = self._bind(self.flat.jump, self.here, [self.x_next], fired).call
        solve = self.loop_solver(NONE, self.here)
        return (call if solve is None else _one_after_the_other(solve, call)), fired

    def plain(self, function: Any, outputs: list[np.ndarray], vectors: Vectors) -> Callable[[], None]:
        """Return the call of another function of (t, x, w, p) between ticks."""
        call: Callable[[], None] = self._bind(function, vectors, outputs).call
        solve = self.loop_solver(NONE, vectors)
        return call if solve is None else _one_after_the_other(solve, call)

    # --- algebraic loops ---------------------------------------------------------------------------------------------

    def loop_solver(self, acting: frozenset[Clock], vectors: Vectors) -> Callable[[], None] | None:
        """Return the call that solves the algebraic loops at some vectors; None where there are none.

        Newton's method with the exact derivative, started from the last solution; a step that makes the residual larger
        is halved, and on, as long as that helps.
        """
        if not self.looped:
            return None
        key = (acting, id(vectors))
        if key in self._solved:
            return self._solved[key]
        function = self.flat.loop_equations(acting)
        if function is None:
            return None
        bound = self._bind(function, vectors)
        r, J = bound.outputs
        where = np.array(active_loops(self.flat, acting))
        n, x, call = len(where), vectors.x, bound.call

        def size_of(r: np.ndarray, v: np.ndarray) -> float:
            return float(np.max(np.abs(r)) / (1.0 + np.max(np.abs(v))))

        def solve() -> None:
            call()
            v = x[where]
            size = float(np.linalg.norm(r))
            for _ in range(_ITERATIONS):
                if not size_of(r, v) > _ROUNDING:
                    break
                try:
                    direction = np.linalg.solve(J.reshape(n, n, order="F"), r)
                except np.linalg.LinAlgError:
                    break
                if not np.all(np.isfinite(direction)):
                    break
                best, step = 0.0, 1.0  # the mismatch itself must shrink: relative to values that run away, any would
                for _ in range(30):
                    x[where] = v - step * direction
                    call()
                    now = float(np.linalg.norm(r))
                    if now < size:
                        best, size = step, now
                    elif best:
                        break
                    if best == 1.0:
                        break
                    step *= 0.5
                if best != step:
                    x[where] = v - best * direction  # the best one; 0 at the level of rounding, or where it is stuck
                    call()
                if not best:
                    break
                v = x[where]
            found = size_of(r, x[where])
            if not found <= TOLERANCE and math.isfinite(found):  # a NaN that comes in is told by who made it
                raise self.unsolved(found, float(vectors.t[0]))

        self._solved[key] = solve
        return solve

    def unsolved(self, residual: float, t: float) -> SimulationError:
        """Return the error of a loop that has no solution, or that Newton's method does not find."""
        loops = "\n".join(self.flat.order.loops)
        path, port = self.flat.order.torn[0]
        return SimulationError(
            f"the algebraic loop was not solved: its residual is {residual:.3g}, expected at most {TOLERANCE:g}. "
            "Newton's method, started from the last solution, got no closer; the loop may have none, or "
            f"several.\n{loops}\n"
            "Break it with a UnitDelay where a delay is real, or solve the equations for the signal by hand.",
            block=path,
            port=port,
            t=t,
        )


def _one_after_the_other(first: Callable[[], None], second: Callable[[], None]) -> Callable[[], None]:
    def both() -> None:
        first()
        second()

    return both
