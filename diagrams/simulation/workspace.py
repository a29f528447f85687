"""The workspace of a run: its numbers, and a diagram's functions bound to them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ...blocks.core import Block, LoopwrightError, ParameterError
from ...blocks.tracing import is_traced_by
from ..compiled import DiagramCode, bind_call
from ..flat import (
    NONE,
    Bound,
    Derivative,
    Evaluators,
    FlatDiagram,
    Schedule,
    TickPattern,
    Vectors,
    evaluate,
    evaluate_apart,
)
from .algebraic_loops import LoopSolver, loop_solver
from .failed_blocks import failure


class Workspace:
    """The numbers of one run, with the diagram's functions bound to them.

    `evaluate` looks at an instant; `tick` and `jump` go beyond it: they take over the next states.
    """

    def __init__(self, flat: FlatDiagram, evaluators: Evaluators | None = None):
        self.flat, self.evaluators = flat, evaluators  # those of the blocks of opaque stages, by path
        self.p = flat.p.copy()
        self.here, self.trial = Vectors(flat, self.p), Vectors(flat, self.p)
        """The instant that the run has reached, and the one that a solver tries."""
        self.x_next = np.zeros(flat.width)
        """x after the instant that was evaluated last."""
        self.z = np.zeros(flat.plant_inputs.total)
        """Inputs of plants and of transport delays there."""
        self.log = np.zeros(flat.log.total + flat.width + bool(flat.loops.slices))
        """Outputs there, by `FlatDiagram.log`; then x before the instant, and, with loops, their residual."""
        self.ok = np.zeros(1)
        """0 where a value was not finite or a guard failed."""
        self.looped = bool(flat.loops.slices)
        self._evaluations: dict[frozenset[TickPattern], Callable[[], None]] = {}
        self._kept: list[Bound] = []
        self._native: Mapping[frozenset[TickPattern], Callable[[], None]] = {}
        """Evaluations of ticks at ``here`` that need no traced function of the whole diagram, by the acting clocks."""
        self.begun = False  # whether the start is found: from then on loops must determine their values
        self.messages: tuple[str, ...] = ()
        self._solved: dict[tuple[frozenset[TickPattern], int], LoopSolver] = {}

    def begin_again(self, flat: FlatDiagram) -> None:
        """Put all numbers to those with which a run of a diagram begins; its functions are those that are bound."""
        self.flat, self.begun = flat, False
        self.p[:], self.messages = flat.p, ()
        for instant in (self.here, self.trial):
            instant.t[0], instant.x[:], instant.w[:] = 0.0, flat.x0, 0.0
        for vector in (self.x_next, self.z, self.log, self.ok):
            vector[:] = 0.0

    def _bind(
        self,
        function: Schedule | Derivative,
        vectors: Vectors,
        outputs: list[np.ndarray] | None = None,
        *more: np.ndarray,
    ) -> Bound:
        arguments = [vectors.t, vectors.x, vectors.w, vectors.p, *more]
        bound = function.bind(arguments, outputs, self.evaluators)
        self._kept.append(bound)  # the buffer lives as long as its call
        return bound

    # --- an instant, at ``here`` -------------------------------------------------------------------------------------

    def put(self, t: float, x: np.ndarray, w: np.ndarray) -> None:
        """Put ``here`` to an instant: its time in s, x and w."""
        self.here.t[0], self.here.x[:], self.here.w[:] = t, x, w

    def restore(self, *, t: float, x: np.ndarray, w: np.ndarray, z: np.ndarray, log: np.ndarray) -> None:
        """Put ``here`` to an instant that was evaluated before, with its results."""
        self.put(t, x, w)
        self.z[:], self.log[:] = z, log

    def evaluate(self, acting: frozenset[TickPattern] = NONE) -> None:
        """Evaluate everything at ``here``, where some clocks act: into x_next, z, log and ok."""
        self._evaluation(acting)()

    def check(self, acting: frozenset[TickPattern] = NONE) -> None:
        """Raise the error of the first block that is to blame, if the last evaluation is not ok."""
        if not self.ok[0]:
            raise failure(self.flat, self.here, self.log, acting, self.evaluators).at(t=float(self.here.t[0]))

    def tick(self, acting: frozenset[TickPattern] = NONE) -> None:
        """Go through a tick at ``here``: evaluate everything, `check` it, and take over the next states."""
        self.evaluate(acting)
        self.check(acting)
        self.here.x[:] = self.x_next

    def _evaluation(self, acting: frozenset[TickPattern]) -> Callable[[], None]:
        if acting not in self._evaluations:
            results = [self.x_next, self.z, self.log, self.ok]
            native = self._native.get(acting)
            call = self._bind(self.flat.at_tick(acting), self.here, results).call if native is None else native
            solve = self.loop_solver(acting, self.here)
            self._evaluations[acting] = call if solve is None else _one_after_the_other(solve, call)
        return self._evaluations[acting]

    def evaluate_in_c(self, find_code: Callable[[], DiagramCode]) -> None:
        """Evaluate ticks in C, with the bits of interpreted ones, where their code can be had."""
        # The functions of a large diagram take seconds to trace as a whole, and calls of its blocks need none of them.
        flat, here = self.flat, self.here
        if flat.loops.slices or flat.in_model_exchange:
            return
        try:
            code = find_code()
        except LoopwrightError:  # the start is then evaluated by Python; `Engine` reports the obstacle
            return
        results = [self.x_next, self.z, self.log, self.ok]
        vectors = [here.t, here.x, here.w, here.p]
        if code.exact:
            self._native = {clocks: bind_call(tick, vectors, results) for clocks, tick in code.ticks.items()}

    def evaluate_with_held(self) -> None:
        """Evaluate the outputs at ``here`` into log, between ticks of a diagram without continuous states."""
        # Sampled blocks put out what they did at the last tick; with algebraic loops in continuous time all blocks do.
        flat, here = self.flat, self.here
        found: dict[str, Any] = {name: here.w[where] for name, where in flat.plant_outputs.slices.items()}
        if not flat.active_loops(NONE):
            kept, apart = self.log[: flat.log.total].copy(), evaluate_apart(self.evaluators)
            instant = evaluate(flat, flat.blocks, NONE, here.t[0], here.x, here.w, here.p, apart=apart, kept=kept)
            found |= {name: instant.values[flat.ports[name]] for name in flat.log.slices if name not in found}
        for name, column in found.items():
            self.log[flat.log.slices[name]] = np.ravel(np.array(column))

    def bind_jump(self) -> Callable[[np.ndarray], None]:
        """Return the call that lets events fire at ``here``, shape (events,), and takes over the states after them."""
        fired = np.zeros(len(self.flat.events))
        call = self._bind(self.flat.jump, self.here, [self.x_next], fired).call
        solve = self.loop_solver(NONE, self.here)
        evaluate = call if solve is None else _one_after_the_other(solve, call)

        def jump(events: np.ndarray) -> None:
            fired[:] = events
            evaluate()
            self.here.x[:] = self.x_next

        return jump

    def set_parameters(self, path: str, block: Block) -> None:
        """Let a block continue with the parameters of another one of its kind."""
        self.check_equations(path, block)
        self.p[self.flat.parameters.slices[path]] = self.flat.pack(path, block)

    def check_equations(self, path: str, block: Block) -> None:
        """Refuse a block whose equations are not those of the block at a path; see `set_parameters`."""
        if not is_traced_by(block, self.flat.origin.table.blocks[path]):
            raise ParameterError(
                "its equations change with these parameters, so that a run can't take them over: it takes numbers of "
                "the same shape, and none in the place of a zero. Start a run of diagram.replace(…).",
                block=path,
            )

    # --- trials of a solver -----------------------------------------------------------------------------------------

    def flow(self) -> Callable[[float, np.ndarray], np.ndarray]:
        """Return the rates of the continuous states, ``f(t, x)``; w is that of ``trial``."""
        return self._of_trial(self.flat.flow)

    def jacobian(self) -> Callable[[float, np.ndarray], np.ndarray]:
        """Return the derivative of `flow` by the continuous states, (n, n); through algebraic loops as well."""
        flat, trial, n = self.flat, self.trial, self.flat.continuous.size
        if not self.looped or self.loop_solver(NONE, trial) is None:
            call = self._of_trial(flat.jacobian)
            return lambda t, x: call(t, x).reshape(n, n, order="F")
        bound = self._bind(flat.jacobian_with_loops, trial)
        solve: Any = self.loop_solver(NONE, trial)
        m = len(flat.active_loops(NONE))

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
        """Return ``g(t, x)`` of all events at ``trial``, and the array of which subsystems are open then."""
        bound = self._bind(self.flat.indicators, self.trial)
        return self._trial_call(bound), bound.outputs[1]

    def _of_trial(self, function: Schedule | Derivative) -> Callable[[float, np.ndarray], np.ndarray]:
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

    def bind_model_exchange(self) -> Callable[[float], np.ndarray]:
        """Return ``z(t)`` at ``here`` between ticks, with the outputs that sampled blocks had at the last tick."""
        log = self.log[: self.flat.log.total]
        bound = self._bind(self.flat.exchange, self.here, None, log)
        solve = self.loop_solver(NONE, self.here)
        t, found, call = self.here.t, bound.outputs[0], bound.call

        def exchange(time: float) -> np.ndarray:
            t[0] = time
            if solve is not None:
                solve()
            call()
            return found

        return exchange

    # --- algebraic loops ---------------------------------------------------------------------------------------------

    def loop_solver(self, acting: frozenset[TickPattern], vectors: Vectors) -> Callable[[], None] | None:
        """Return the call that solves the algebraic loops at some of its vectors; None where there are none."""
        loops = self.loops(acting, vectors)
        if loops is None or vectors is not self.here:
            return None if loops is None else loops.solve

        def solve() -> None:  # at ``here`` it also refuses values that the loops do not determine
            loops.solve(search=not self.begun)
            if self.begun:
                loops.check_determined()

        return solve

    def loops(self, acting: frozenset[TickPattern], vectors: Vectors) -> LoopSolver | None:
        """Return the solver of the algebraic loops at some of its vectors; None where there are none."""
        if not self.looped:
            return None
        key = (acting, id(vectors))
        if key not in self._solved:
            function = self.flat.loop_equations(acting)
            if function is None:
                return None
            bound = self._bind(function, vectors)
            self._solved[key] = loop_solver(self.flat, acting, vectors.t, vectors.x, bound.call, *bound.outputs)
        return self._solved[key]

    def solve_loops(self, acting: frozenset[TickPattern], t: float, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return x with the algebraic loops solved at an instant; they are sought from the values in x on."""
        loops = self.loops(acting, self.here)
        if loops is None:
            return x
        self.put(t, x, w)
        loops.solve()
        loops.check_determined()
        return self.here.x.copy()

    def begin(self, acting: frozenset[TickPattern]) -> None:
        """Let a run begin at ``here``: ``messages`` names other solutions that the algebraic loops have there."""
        loops = self.loops(acting, self.here)
        if loops is not None:
            loops.solve()
            loops.check_determined()
            self.messages = (loops.describe(others),) if (others := loops.others()) else ()


def _one_after_the_other(first: Callable[[], None], second: Callable[[], None]) -> Callable[[], None]:
    def both() -> None:
        first()
        second()

    return both
