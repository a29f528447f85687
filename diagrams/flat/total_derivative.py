"""The total derivative of a schedule: the chain rule over its stages."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, partial
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core import Layout, ParameterError
from ...blocks.tracing import differentiate, extrapolate
from .fast_functions import speed_up
from .stages import Bound, Evaluator, Evaluators, OpaqueStage, Schedule, TracedStage, bind_function, call_function

By = tuple[str, Sequence[int] | None]
"""An argument of a schedule, and the entries by which it is differentiated; None for all."""

_FORWARD = 0.1 * float(np.cbrt(np.finfo(float).eps))
"""Step of a forward difference by time, relative to it."""
ALONG = 2.0**-11
"""Step of a difference of fourth order, relative to 1 + the size of what moves."""


class Derivative:
    """The results of a schedule and their total derivatives by some of its arguments.

    It is evaluated into the results, where they are wanted (``values``), then for each result its derivative by each
    argument, or by some entries of it. Without opaque stages this is one CasADi function. With some, ``D``, the
    derivative of everything that is passed from stage to stage, is built up on the way: where a stage makes part of c
    from the argument v and from c, that part of D is ∂/∂v + ∂/∂c D. Of an opaque stage the evaluator gives the
    derivative.
    """

    def __init__(self, schedule: Schedule, by: Sequence[By], *, values: bool = True):
        self.schedule, self.by, self.values = schedule, tuple(by), values
        owner = next((stage.path for stage in schedule.opaque if stage.has_parameters), None)
        if owner is not None and any(name == "p" for name, _ in by):
            raise ParameterError(
                "it is evaluated from outside, so that there is no derivative by its parameters. Leave them as they "
                "are.",
                block=owner,
            )
        numels = dict(zip(schedule.arguments, (a.numel() for a in schedule.last.arguments), strict=False))
        sizes = [numels[name] if entries is None else len(entries) for name, entries in by]
        self._sizes = sizes
        self._columns = Layout.of({str(i): (size,) for i, size in enumerate(sizes)})
        traced = [stage for stage in schedule.stages if isinstance(stage, TracedStage)]
        self._functions = {id(stage): self._differentiate(stage) for stage in traced}

    def _differentiate(self, stage: TracedStage) -> Any:
        """Return the function of a traced stage's results and its derivatives, by the arguments and by c."""
        symbols = dict(zip(self.schedule.arguments, stage.arguments, strict=False))
        staged = bool(self.schedule.opaque)
        whole = [] if not staged else [(stage.arguments[-1], None)]
        variables = [*((symbols[name], entries) for name, entries in self.by), *whole]
        slopes = _slopes(stage.results, variables)
        names = [*self.schedule.arguments, *(["passed"] if staged else [])]
        shown = [ca.densify(e) for e in stage.results if staged or self.values]
        outputs = [f"o{i}" for i in range(len(shown) + len(slopes))]
        return ca.Function(f"{stage.name}_derivative", [*stage.arguments], [*shown, *slopes], names, outputs)

    def is_constant(self, result: str, argument: str, entries: Sequence[int] | None = None) -> bool:
        """Whether no derivative of a result depends on an argument, or on some of its entries.

        False where a stage has an evaluator, or tables: its operations can't be looked at.
        """
        found = self._operations(result)
        if found is None:
            return False
        made, symbols = found
        slopes = ca.jacobian(made, ca.vertcat(*(symbols[name] for name, _ in self.by)))
        moved = symbols[argument] if entries is None else symbols[argument][list(entries)]
        return not ca.depends_on(slopes, moved)

    def is_zero(self, result: str, argument: str) -> bool:
        """Whether the derivative of a result by an argument is 0 wherever there is one, as that of a step by time.

        False where a stage has an evaluator, or tables: its operations can't be looked at.
        """
        found = self._operations(result)
        if found is None:
            return False
        made, symbols = found
        return bool(ca.sparsify(ca.jacobian(made, symbols[argument])).nnz() == 0)

    def _operations(self, result: str) -> tuple[Any, dict[str, Any]] | None:
        """Return a result by symbols of the arguments, operation by operation; None where it can't be looked at.

        Seen from outside, each call of a block's function depends on all that it takes.
        """
        last = self.schedule.last
        if self.schedule.opaque:
            return None
        try:
            f = ca.Function("whole", [*last.arguments], [last.results[self.schedule.results.index(result)]]).expand()
        except RuntimeError:
            return None
        symbols = dict(zip(self.schedule.arguments, f.sx_in(), strict=True))
        return f.call(list(symbols.values()))[0], symbols

    @cached_property
    def fast(self) -> Any:
        """The one function of a schedule without opaque stages as it is evaluated fastest."""
        return speed_up(self._functions[id(self.schedule.last)])

    def __call__(self, *arguments: Any, evaluators: Evaluators | None = None) -> list[np.ndarray]:
        """Evaluate it with numbers; return the results, flat, if they are wanted, and the derivatives as matrices."""
        schedule = self.schedule
        count = len(schedule.results)
        if not schedule.opaque:
            made = call_function(self._functions[id(schedule.last)], arguments)
            shown = count if self.values else 0
            return [*map(np.ravel, made[:shown]), *made[shown:]]
        c, D = np.zeros(schedule.width), np.zeros((schedule.width, self._columns.total))
        made = []
        for stage in schedule.stages:
            if isinstance(stage, OpaqueStage):
                self._pass_through(stage, stage.evaluator(evaluators or {}), float(np.ravel(arguments[0])[0]), c, D)
                continue
            made = call_function(self._functions[id(stage)], [*arguments, c])
            if stage is not schedule.last:
                c[stage.makes] = np.ravel(made[0])
                D[stage.makes] = np.hstack(made[1:-1]) + made[-1] @ D
        wide, many = made[count:], len(self.by) + 1
        found = [np.hstack(wide[i : i + many - 1]) + wide[i + many - 1] @ D for i in range(0, count * many, many)]
        cut = [J[:, where] for J in found for where in self._columns.slices.values()]
        return [*(map(np.ravel, made[:count]) if self.values else ()), *cut]

    def _pass_through(self, stage: OpaqueStage, evaluator: Evaluator, t: float, c: np.ndarray, D: np.ndarray) -> None:
        """Evaluate an opaque stage, and lead the derivative through it."""
        x, u = c[stage.states].copy(), c[stage.inputs].copy()
        c[stage.makes] = evaluator.evaluate(stage.names, t, x, u)
        J = evaluator.differentiate(stage.names, t, x, u)
        J = _differences(stage, evaluator, t, x, u) if J is None else np.asarray(J)
        D[stage.makes] = J[:, 1:] @ np.vstack([D[stage.states], D[stage.inputs]])
        for (name, _), where in zip(self.by, self._columns.slices.values(), strict=True):
            if name == "t":
                known = np.isfinite(J[:, :1]).all()
                D[stage.makes, where] += J[:, :1] if known else _forward_by_time(stage, evaluator, t, x, u)

    @cached_property
    def _forward(self) -> Any:
        """The forward derivative of the one function of a schedule without opaque stages."""
        forward = self._functions[id(self.schedule.last)].forward(1)
        given = forward.mx_in()
        return ca.Function("forward", given, [ca.densify(e) for e in forward.call(given)])

    def along(
        self, arguments: Sequence[np.ndarray], direction: Sequence[np.ndarray], evaluators: Evaluators | None = None
    ) -> tuple[list[np.ndarray], list[np.ndarray], float]:
        """Return what a call returns, its derivative along a direction, and an estimate of that one's largest error.

        It is exact without opaque stages; with some it is made of central differences of fourth order.
        """
        schedule = self.schedule
        if not schedule.opaque:
            values = call_function(self._functions[id(schedule.last)], arguments)
            along = call_function(self._forward, [*arguments, *(v.ravel(order="F") for v in values), *direction])
            count = len(schedule.results) if self.values else 0
            return (
                [*map(np.ravel, values[:count]), *values[count:]],
                [*map(np.ravel, along[:count]), *along[count:]],
                0.0,
            )
        values = self(*arguments, evaluators=evaluators)
        size = max(size_of_motion(a, d) for a, d in zip(arguments, direction, strict=True))
        if size == 0.0:
            return values, [np.zeros_like(v) for v in values], 0.0

        def difference(h: float) -> list[np.ndarray]:
            ends = [[a + s * h / size * d for a, d in zip(arguments, direction, strict=True)] for s in (1.0, -1.0)]
            high, low = (self(*end, evaluators=evaluators) for end in ends)
            return [(a - b) * (size / (2.0 * h)) for a, b in zip(high, low, strict=True)]

        near, far = difference(ALONG), difference(2.0 * ALONG)
        error = max((float(np.max(np.abs(a - b), initial=0.0)) for a, b in zip(near, far, strict=True)), default=0.0)
        return values, [extrapolate(a, b) for a, b in zip(near, far, strict=True)], error

    def bind(
        self,
        arguments: Sequence[np.ndarray],
        results: Sequence[np.ndarray] | None = None,
        evaluators: Evaluators | None = None,
    ) -> Bound:
        """Return it bound to vectors; see `Schedule.bind`. Matrices are written column by column."""
        if not self.schedule.opaque:
            return bind_function(self.fast, arguments, results)
        rows = [result.numel() for result in self.schedule.last.results]
        sizes = [*(rows if self.values else ()), *(n * size for n in rows for size in self._sizes)]
        into = [np.zeros(size) for size in sizes] if results is None else [*results]

        def call() -> None:
            for vector, value in zip(into, self(*arguments, evaluators=evaluators), strict=True):
                vector[:] = value.ravel(order="F")

        return Bound(call, into)


def size_of_motion(value: np.ndarray, slope: np.ndarray) -> float:
    """Return the largest slope, relative to 1 + the size of the value; entries that do not move may be no numbers."""
    moves = slope != 0.0
    return float(np.max(np.abs(slope[moves]) / (1.0 + np.abs(value[moves])), initial=0.0))


def _slopes(results: Sequence[Any], variables: Sequence[tuple[Any, Sequence[int] | None]]) -> list[Any]:
    """Return the derivative of each column by each symbol, or by some entries of it: all columns at once."""
    together, cuts = ca.vertcat(*results), Layout.of({str(i): (e.numel(),) for i, e in enumerate(results)}).cuts
    by_symbol = []
    for symbol, entries in variables:
        slope = ca.jacobian(together, symbol)
        parts = ca.vertsplit(slope if entries is None else slope[:, list(entries)], cuts)
        by_symbol.append([ca.densify(part) for part in parts])
    return [slopes[i] for i in range(len(results)) for slopes in by_symbol]


def _forward_by_time(stage: OpaqueStage, evaluator: Evaluator, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the derivative of a block by time, by forward differences of third order: an event may lie just before."""
    h = _FORWARD * max(abs(t), 1.0)
    f = [np.array(evaluator.evaluate(stage.names, t + k * h, x, u)) for k in range(4)]
    return ((-11.0 * f[0] + 18.0 * f[1] - 9.0 * f[2] + 2.0 * f[3]) / (6.0 * h))[:, None]


def _differences(stage: OpaqueStage, evaluator: Evaluator, t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the derivative of a block by (t, x, u), by central differences of fourth order."""
    at = np.concatenate([[t], x, u])

    def evaluate(i: int, to: float) -> list[np.ndarray]:
        v = at.copy()
        v[i] = to
        return [np.array(evaluator.evaluate(stage.names, float(v[0]), v[1 : 1 + x.size], v[1 + x.size :]))]

    columns = [differentiate(partial(evaluate, i), v, max(abs(v), 1.0))[0] for i, v in enumerate(at.tolist())]
    return np.array(columns).T
