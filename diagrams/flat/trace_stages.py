"""Tracing a schedule: the evaluation of all blocks is cut at every block that has an evaluator."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import casadi as ca

from ...blocks.core import without_collection
from .evaluation import JUMP, Apart, Instant
from .stages import OpaqueStage, Schedule, TracedStage
from .vectors import join_columns


@without_collection
def trace_schedule(
    name: str,
    arguments: Mapping[str, Any],
    results: Callable[[Apart], Mapping[str, Any]],
    *,
    by_block: bool = False,
) -> Schedule:
    """Trace a function of the whole diagram by symbols, the time ``t`` first.

    ``results`` evaluates the diagram with these symbols. It is called with what `evaluate` takes as ``apart``: this
    cuts the evaluation at the blocks that have an evaluator. ``by_block`` does the operations of each block as they
    are; else those of all blocks are simplified together.
    """
    cuts = _Cuts()
    made = {n: ca.densify(ca.MX(e)) for n, e in results(cuts).items()}  # a buffer holds every entry, zeros too
    names, symbols = tuple(arguments), tuple(arguments.values())
    _drop_unused(made.values(), cuts.made)
    if not any(cut.needed for cut in cuts.made):
        made = _join_again(made, cuts.made)
        function = ca.Function(name, [*symbols], [*made.values()], [*names], [*made])
        last = TracedStage(name, symbols, tuple(made.values()), function, slice(0, 0), by_block)
        return Schedule(name, names, tuple(made), (last,), 0)
    made = _join_again(made, cuts.made)
    return _in_stages(name, names, symbols, made, [cut for cut in cuts.made if cut.needed])


@dataclass
class _StageCut:
    """Where an evaluator evaluates a block, and what was made between that and the cut before.

    Attributes
    ----------
    passed : list of (symbol, expression)
        Columns that were made since the cut before; behind the cut the symbols stand for them.
    outputs : list of MX
        Symbols of what the block makes.
    """

    path: str
    names: tuple[str, ...]
    states: Any
    inputs: Any
    has_parameters: bool
    passed: list[tuple[Any, Any]]
    outputs: list[Any]
    by_time: bool
    may_drop: bool
    """Whether it is left out where nothing needs it; a jump is never: it changes what the block keeps."""
    needed: bool = True
    """Whether a later stage, or a result, needs what the block makes."""


class _Cuts:
    """Cuts an evaluation with symbols: called for each block that has an evaluator."""

    def __init__(self) -> None:
        self.made: list[_StageCut] = []

    def __call__(
        self, instant: Instant, path: str, names: tuple[str, ...], states: Any, inputs: Sequence[Any]
    ) -> list[Any]:
        passed: dict[int, tuple[Any, Any]] = {}

        def carry(column: Any) -> Any:
            if not isinstance(column, ca.MX) or column.is_constant() or column.is_symbolic():
                return column
            key = column.__hash__()
            if key not in passed:
                passed[key] = ca.MX.sym("passed", column.numel()), column
            return passed[key][0]

        own = instant.layout.parameters.slices[path]  # its sample time, and its parameters
        outputs = [ca.MX.sym(f"{path}.{name}", instant.size_of(path, name)) for name in names]
        columns = [ca.MX(ca.DM(u)) if not isinstance(u, ca.MX) else u for u in inputs]
        instant.replace_columns(carry)
        self.made.append(
            _StageCut(
                path,
                names,
                states,
                join_columns(columns),
                own.stop > own.start + 1,
                [*passed.values()],
                outputs,
                _varies(instant, path, names),
                names != (JUMP,) and path in instant.layout.in_model_exchange,
            )
        )
        return outputs


def _varies(instant: Instant, path: str, names: tuple[str, ...]) -> bool:
    """Whether equations of a block that has an evaluator may depend on time, as far as the block says."""
    depends = instant.functions.traced[path].depends
    return path not in instant.layout.in_model_exchange or any("t" in depends.get(name, "t") for name in names)


def _in_stages(
    name: str, names: tuple[str, ...], symbols: tuple[Any, ...], results: Mapping[str, Any], cuts: Sequence[_StageCut]
) -> Schedule:
    """Return the schedule of an evaluation that was cut: all that is passed gets its place in one vector c."""
    places: list[tuple[Any, slice]] = []
    width = 0

    def place(size: int) -> slice:
        nonlocal width
        width += size
        return slice(width - size, width)

    parts: list[tuple[list[Any], slice, OpaqueStage]] = []
    for cut in cuts:
        first = width
        places += [(symbol, place(symbol.numel())) for symbol, _ in cut.passed]
        states, inputs = place(cut.states.numel()), place(cut.inputs.numel())
        end = width
        places += [(symbol, place(symbol.numel())) for symbol in cut.outputs]
        opaque = OpaqueStage(cut.path, cut.names, states, inputs, slice(end, width), cut.has_parameters, cut.by_time)
        parts.append(([*(e for _, e in cut.passed), cut.states, cut.inputs], slice(first, end), opaque))
    c = ca.MX.sym("c", width)
    known = [symbol for symbol, where in places if where.stop > where.start]
    values = [c[where] for _, where in places if where.stop > where.start]

    def of_c(expressions: Iterable[Any]) -> tuple[Any, ...]:
        return tuple(ca.densify(e) for e in ca.substitute([*expressions], known, values))

    stages: list[TracedStage | OpaqueStage] = []
    arguments, names_in = (*symbols, c), [*names, "passed"]
    for i, (expressions, makes, opaque) in enumerate(parts):
        if makes.stop > makes.start:
            made = of_c([ca.vertcat(*expressions)])
            function = ca.Function(f"{name}_{i}", [*arguments], [*made], names_in, ["made"])
            stages.append(TracedStage(f"{name}_{i}", arguments, made, function, makes))
        stages.append(opaque)
    made = of_c(results.values())
    function = ca.Function(name, [*arguments], [*made], names_in, [*results])
    stages.append(TracedStage(name, arguments, made, function, slice(0, 0)))
    return Schedule(name, names, tuple(results), tuple(stages), width)


def _join_again(results: Mapping[str, Any], cuts: Sequence[_StageCut]) -> dict[str, Any]:
    """Return the results with whatever was passed over cuts that nothing needs; so do later cuts."""
    expressions = [*results.values()]
    for i, cut in reversed([*enumerate(cuts)]):
        if cut.needed or not cut.passed:
            continue
        symbols, passed = zip(*cut.passed, strict=True)
        later = [of for of in cuts[i + 1 :] if of.needed]
        joined = [
            *expressions,
            *chain.from_iterable((of.states, of.inputs, *(e for _, e in of.passed)) for of in later),
        ]
        found = iter(ca.substitute(joined, [*symbols], [*passed]))
        expressions = [next(found) for _ in expressions]
        for of in later:
            of.states, of.inputs = next(found), next(found)
            of.passed = [(symbol, next(found)) for symbol, _ in of.passed]
    return dict(zip(results, expressions, strict=True))


def _drop_unused(results: Iterable[Any], cuts: Sequence[_StageCut]) -> None:
    """Leave out what no later stage needs of what was made before a cut, and evaluations that nothing needs."""
    needed = _symbols_of(results)
    for cut in reversed(cuts):
        cut.passed = [(symbol, e) for symbol, e in cut.passed if symbol.__hash__() in needed]
        cut.needed = any(symbol.__hash__() in needed for symbol in cut.outputs) or not cut.may_drop
        own = [cut.states, cut.inputs] if cut.needed else []
        needed |= _symbols_of([*(e for _, e in cut.passed), *own])


def _symbols_of(expressions: Iterable[Any]) -> set[int]:
    return {symbol.__hash__() for e in expressions for symbol in ca.symvar(e)}
