"""Staged schedules: a function of the whole diagram as a sequence of stages.

At an instant a diagram is one function of ``(t, x, w, p)``. Some blocks can't be part of a traced function: an
`Evaluator` evaluates them, by a library in C or by Python. Such a block splits the function into *stages*:

    traced stage       one CasADi function of (t, x, w, p, c): everything between two blocks that have an
                       evaluator. It writes a part of c, the last one the results.
    opaque stage       one block, called with its states and inputs, which are in c; it writes its outputs, or the
                       rates of its states, into c.

The vector ``c`` carries what later stages need. A block whose outputs do not depend on an input is in two stages:
its outputs come first, its rates when the input is known, as in the order of evaluation.

A `Schedule` without an opaque stage has exactly one stage, and that is an ordinary CasADi function: every diagram of
traced blocks is evaluated in this way. The total derivative of a schedule is the chain rule over its stages
(`loopwright.diagrams.flat.total_derivative`).

Two uses build on this:

- *Model exchange.* The outputs and rates of such an FMU depend on the state that a solver tries, so that it is
  evaluated within the flow, the outputs and the indicators. Its instance is an `Evaluator`: fmi3SetTime,
  fmi3SetContinuousStates and fmi3SetFloat64 for what comes in, fmi3GetFloat64 and
  fmi3GetContinuousStateDerivatives for what goes out, fmi3GetDirectionalDerivative for the Jacobian. As a CasADi
  callback it would cost 15 µs a call and lose its derivatives.
- *Compiled code.* Every traced stage becomes one C function with the arguments that are listed here; the compiled loop
  calls them in turn, and the FMUs between them through function pointers. ``c`` is one array.

Blocks of users' own Python (`Block.opaque`) are callbacks in a traced stage nevertheless: in a sampled subsystem they
are composed with a discretization, which needs them as functions, and their numbers are the same to the last bit.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core import EvaluationVectors, Layout, Wanted
from .evaluation import Apart, Instant, no_evaluator, sort_names
from .fast_functions import share_terms, speed_up


class Evaluator(ABC):
    """Evaluates a block that the traced functions leave out; its parameters are its own."""

    @abstractmethod
    def evaluate(self, names: tuple[str, ...], t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return the equations that are wanted, one after the other, flat.

        Parameters
        ----------
        names : tuple of str
            Outputs by their names; ``"next"``: the rates of all states (in a sampled subsystem the next states);
            ``"guards"``; ``"indicators"``: one for each event; ``"jump"``: all states after events.
        t : float
            Time in s.
        x, u : ndarray
            The block's states and inputs, flat. Inputs that none of ``names`` depends on may be zeros. Behind them, for
            ``"jump"``, is 1 for each event that fires, else 0.
        """

    @abstractmethod
    def differentiate(self, names: tuple[str, ...], t: float, x: np.ndarray, u: np.ndarray) -> np.ndarray | None:
        """Return the derivative of `evaluate` by (t, x, u), shape (n, 1 + x.size + u.size); None: by differences.

        A column by t that is not finite is computed by differences, where it is needed.
        """


Evaluators = Mapping[str, Evaluator]
"""Evaluators of the blocks of opaque stages, by path; they belong to one run."""


@dataclass(frozen=True, eq=False)
class TracedStage:
    """One CasADi function over the blocks between two that have an evaluator."""

    name: str
    arguments: tuple[Any, ...]  # symbols; behind them that of c, where there is something to pass on
    results: tuple[Any, ...]  # expressions: of the part of c that it makes; of the last stage the results
    function: Any
    makes: slice  # which part of c; empty for the last stage
    by_block: bool = False  # the operations of each block are done as they are

    @cached_property
    def fast(self) -> Any:
        """The function as it is evaluated fastest, with the same results to the last bit; see `speed_up`."""
        return speed_up(self.function, simplify=not self.by_block)

    @cached_property
    def evaluated(self) -> Any:
        """The function as it is evaluated in interpreted runs, and as it is compiled: see `share_terms`."""
        plain = self.by_block or not self.fast.is_a("SXFunction")
        return self.fast if plain else share_terms(self.fast)


@dataclass(frozen=True, eq=False)
class OpaqueStage:
    """A block that an `Evaluator` evaluates."""

    path: str
    names: tuple[str, ...]  # the equations that are wanted of it; see `Evaluator.evaluate`
    states: slice  # where its states, and its inputs, are in c
    inputs: slice
    makes: slice  # which part of c it makes
    has_parameters: bool  # it has numbers among the diagram's parameters
    by_time: bool = True  # it may depend on time by itself

    def evaluator(self, evaluators: Evaluators) -> Evaluator:
        """Return what evaluates it."""
        if self.path not in evaluators:
            raise no_evaluator(self.path)
        return evaluators[self.path]

    def vectors(self, t: np.ndarray, c: np.ndarray) -> EvaluationVectors:
        """Return its parts of c."""
        return EvaluationVectors(t, c[self.states], c[self.inputs], c[self.makes])

    @property
    def wanted(self) -> Wanted:
        """Its ``names``, other than `JUMP`, sorted by kind."""
        return sort_names(self.names)

    def run(self, evaluator: Evaluator, t: np.ndarray, c: np.ndarray) -> None:
        """Evaluate it at c, and write its part of c."""
        c[self.makes] = evaluator.evaluate(self.names, float(t[0]), c[self.states], c[self.inputs])


@dataclass(frozen=True, eq=False)
class Schedule:
    """A function of the whole diagram, in stages; the last one is traced and makes the results."""

    name: str
    arguments: tuple[str, ...]  # columns, the time ``t`` first
    results: tuple[str, ...]
    stages: tuple[TracedStage | OpaqueStage, ...]
    width: int  # entries of c, which is passed from stage to stage

    @property
    def opaque(self) -> tuple[OpaqueStage, ...]:
        """Its opaque stages."""
        return tuple(stage for stage in self.stages if isinstance(stage, OpaqueStage))

    @property
    def last(self) -> TracedStage:
        """The stage that makes the results."""
        last = self.stages[-1]
        assert isinstance(last, TracedStage)
        return last

    @property
    def function(self) -> Any:
        """The one CasADi function of a schedule without opaque stages."""
        if self.opaque:
            raise no_evaluator(self.opaque[0].path)
        return self.last.function

    def __call__(self, *arguments: Any, evaluators: Evaluators | None = None) -> list[np.ndarray]:
        """Evaluate it with numbers, one column for each argument; return the results, flat."""
        c, t = np.zeros(self.width), np.ravel(arguments[0])
        made: list[np.ndarray] = []
        for stage in self.stages:
            if isinstance(stage, OpaqueStage):
                stage.run(stage.evaluator(evaluators or {}), t, c)
                continue
            values = stage.function.call([*arguments, c] if self.width else [*arguments])
            made = [np.ravel(np.array(value)) for value in values]
            if stage is not self.last:
                c[stage.makes] = made[0]
        return made

    def bind(
        self,
        arguments: Sequence[np.ndarray],
        results: Sequence[np.ndarray] | None = None,
        evaluators: Evaluators | None = None,
    ) -> Bound:
        """Return it bound to vectors, whose values at each call count; without results it makes new vectors."""
        if len(self.stages) == 1:
            return bind_function(self.last.evaluated, arguments, results)
        c, calls, kept = np.zeros(self.width), list[Callable[[], None]](), list[Bound]()
        for stage in self.stages:
            if isinstance(stage, OpaqueStage):
                calls.append(partial(stage.run, stage.evaluator(evaluators or {}), arguments[0], c))
            else:
                into = results if stage is self.last else [c[stage.makes]]
                kept.append(bind_function(stage.evaluated, [*arguments, c], into))
                calls.append(kept[-1].call)
        return Bound(_one_after_the_other(calls), kept[-1].outputs, kept)

    def depends(self, result: str, argument: str) -> np.ndarray:
        """Return which entries of a result may depend on which of an argument, shape (n, m), of truth values."""
        i, k = self.results.index(result), self.arguments.index(argument)
        of_c = np.zeros((self.width, self.last.arguments[k].numel()), bool)
        for stage in self.stages:
            if isinstance(stage, OpaqueStage):
                through = np.any(of_c[[*_range(stage.states), *_range(stage.inputs)]], axis=0)
                of_c[stage.makes] = through | (argument == "t" and stage.by_time)
            elif stage is not self.last:
                of_c[stage.makes] = _depends(stage, 0, k, of_c)
        return _depends(self.last, i, k, of_c)


def evaluate_apart(evaluators: Evaluators | None) -> Apart:
    """Return what `evaluate` takes as ``apart`` where it evaluates with numbers."""

    def call(
        instant: Instant, path: str, names: tuple[str, ...], states: np.ndarray, inputs: Sequence[Any]
    ) -> list[Any]:
        if path not in (evaluators or {}):
            raise no_evaluator(path)
        u = np.concatenate([np.zeros(0), *(np.ravel(np.array(column)) for column in inputs)])
        made = (evaluators or {})[path].evaluate(names, float(instant.t), np.ravel(states), u)
        parts = Layout.of({name: (instant.size_of(path, name),) for name in names}).split(np.asarray(made))
        return [ca.DM(part) for part in parts.values()]

    return call


class Bound:
    """A function bound to vectors: ``call`` evaluates it into ``outputs``, matrices column by column."""

    def __init__(self, call: Callable[[], None], outputs: list[np.ndarray], kept: Any = None):
        self.call, self.outputs = call, outputs
        self.kept = kept
        """Whatever must live as long as the call."""


def bind_function(function: Any, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray] | None = None) -> Bound:
    """Bind a CasADi function to vectors, through its buffers."""
    buffer, call = function.buffer()
    made = [np.zeros(function.numel_out(i)) for i in range(function.n_out())] if results is None else [*results]
    for i, vector in enumerate(arguments):
        buffer.set_arg(i, _view(vector))
    for i, vector in enumerate(made):
        buffer.set_res(i, _view(vector))
    return Bound(call, made, buffer)


def call_function(function: Any, arguments: Sequence[Any]) -> list[np.ndarray]:
    """Return the results of a CasADi function, all of them dense, as their own matrices.

    Its buffers take a fifth of the time that a call with CasADi's matrices takes.
    """
    buffer, call = function.buffer()
    given = [np.ascontiguousarray(np.ravel(a), dtype=float) for a in arguments]
    made = [np.empty(function.size_out(i), order="F") for i in range(function.n_out())]
    for i, vector in enumerate(given):
        buffer.set_arg(i, _view(vector))
    for i, matrix in enumerate(made):
        buffer.set_res(i, _view(matrix.ravel(order="K")))
    call()
    return made


def _view(vector: np.ndarray) -> Any:
    buffer: Any = vector  # stubs of NumPy don't agree on whether an array is a buffer
    return memoryview(buffer)


def _range(part: slice) -> range:
    return range(part.start, part.stop)


def _depends(stage: TracedStage, i: int, k: int, of_c: np.ndarray) -> np.ndarray:
    """Return what result ``i`` of a stage depends on of argument ``k``: straight, or through c."""

    def pattern(argument: int) -> np.ndarray:
        return np.array(ca.DM(stage.function.jac_sparsity(i, argument), 1).full() != 0.0)

    found = pattern(k)
    return found if not len(of_c) else found | (pattern(len(stage.arguments) - 1) @ of_c)


def _one_after_the_other(calls: Sequence[Callable[[], None]]) -> Callable[[], None]:
    kept = tuple(calls)

    def call() -> None:
        for each in kept:
            each()

    return call
