"""Functions of a large diagram as runs of equal blocks: ticks, rates, indicators, jumps; see `grouping`."""

from __future__ import annotations

import ctypes
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any
from weakref import WeakSet

import numpy as np

from ..flat import FlatDiagram, TickPattern, bind_function
from .bound_functions import (
    BlockBinder,
    BoundFunction,
    CodeOfFunctions,
    FunctionInC,
    TickStructure,
    address_of,
    at,
    call_for_c,
    list_vectors,
)
from .compiled_libraries import load_runtime
from .grouping import BlockCalls, PartTables, PythonCall, TickTables, make_part_tables, make_tables
from .kernels import BlockKinds, Kernels
from .machine import BlockProgramStructure
from .rate_differences import Columns, SlopesByDifferences, find_columns

_AT, _INT = ctypes.c_void_p, ctypes.c_int64
_Python = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int64, ctypes.c_int64)


class _GroupInC(ctypes.Structure):
    _fields_ = [
        *((name, _AT) for name in ("runs", "rows")),
        ("count", _INT),
        *((name, _AT) for name in ("generated", "programs")),
        ("python", _Python),
    ]


class _Tick(ctypes.Structure):
    _fields_ = [
        ("calls", _GroupInC),
        *((name, _INT) for name in ("states", "outside", "log", "next")),
        *((name, _AT) for name in ("inputs", "guards", "made", "taken")),
        *((name, _INT) for name in ("n_inputs", "n_guards", "n_loops", "residual")),
        ("unread", _AT),
        ("n_unread", _INT),
    ]


class _PartInC(ctypes.Structure):
    _fields_ = [
        ("calls", _GroupInC),
        *((name, _INT) for name in ("states", "outside", "more")),
        ("where", _AT),
        ("lengths", _INT * 2),
    ]


@dataclass(frozen=True, eq=False)
class GroupedFunction(FunctionInC):
    """A function of a large diagram as runs of equal blocks; the C function at ``address`` goes over its tables."""

    tables: TickTables | PartTables
    kernels: Kernels
    address: int
    _bound: WeakSet[BoundFunction] = field(default_factory=WeakSet, kw_only=True)

    @property
    def calls_python(self) -> bool:
        """Whether Python evaluates some of the blocks."""
        return len(self.tables.calls.python) > 0

    def bind(
        self, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray], bind_block: BlockBinder | None = None
    ) -> BoundFunction:
        """Return it bound to vectors, for one call at a time."""
        v, kept, failures = self.tables.memory.copy(), list[Any](), list[Exception]()
        structure = self._structure(arguments)
        structure.calls = _bind_calls(self.tables.calls, self.kernels, v, arguments[3], kept, failures)
        lists = list_vectors(arguments, 5), list_vectors(results, 4)
        evaluate = TickStructure(self.address, *map(ctypes.addressof, (*lists, structure)), at(v))
        bound = BoundFunction(evaluate, arguments, results, structure, v, [self, lists, kept], failures)
        self._bound.add(bound)
        return bound

    def hand_over(self, to: Any) -> None:
        """Let other kernels of the same blocks take over wherever it is bound; C must not run meanwhile."""
        for bound in self._bound:
            p = bound.arguments[3]
            bound.inner.calls = _bind_calls(to.tables.calls, to.kernels, bound.memory, p, bound.kept, bound.failures)

    @abstractmethod
    def _structure(self, arguments: Sequence[np.ndarray]) -> Any:
        """Return what C knows of it, without its calls."""


@dataclass(frozen=True, eq=False)
class GroupedTick(GroupedFunction):
    """A tick, ``(t, x, w, p) -> (x_next, z, log, ok)``."""

    tables: TickTables

    def _structure(self, arguments: Sequence[np.ndarray]) -> Any:
        tables = self.tables
        return _Tick(
            states=arguments[1].size,
            outside=arguments[2].size,
            log=tables.log,
            next=tables.next,
            inputs=at(tables.inputs),
            guards=at(tables.guards),
            made=at(tables.made),
            taken=at(tables.taken),
            n_inputs=tables.inputs.size,
            n_guards=tables.guards.size,
            n_loops=tables.made.size,
            residual=tables.residual,
            unread=at(tables.unread),
            n_unread=tables.unread.size,
        )


@dataclass(frozen=True, eq=False)
class GroupedPart(GroupedFunction):
    """A function between ticks: rates, indicators, or states after events."""

    tables: PartTables

    def _structure(self, arguments: Sequence[np.ndarray]) -> Any:
        return _PartInC(
            states=arguments[1].size,
            outside=arguments[2].size,
            more=arguments[4].size if len(arguments) > 4 else 0,
            where=at(self.tables.where),
            lengths=(ctypes.c_int64 * 2)(*self.tables.lengths),
        )


def _bind_calls(
    calls: BlockCalls, kernels: Kernels, v: np.ndarray, p: np.ndarray, kept: list[Any], failures: list[Exception]
) -> _GroupInC:
    """Return the calls of blocks as C knows them; what must live as long is added to ``kept``."""
    programs = [program.bind() for program in kernels.programs]
    array = (BlockProgramStructure * len(programs))(*(structure for structure, _ in programs))
    python = _Python(_python_calls([_bind_python(call, kernels.of_python, v, p) for call in calls.python], failures))
    kept += [calls, kernels, programs, array, python]
    return _GroupInC(
        runs=at(calls.runs),
        rows=at(calls.rows),
        count=len(calls.runs),
        generated=kernels.generated,
        programs=ctypes.addressof(array) if programs else None,
        python=python,
    )


def _python_calls(calls: Sequence[Callable[[], None]], failures: list[Exception]) -> Callable[[int, int], int]:
    """Return the function by which C has Python evaluate some blocks, one after the other."""

    def evaluate(first: int, count: int) -> int:
        def several() -> None:
            for call in calls[first : first + count]:
                call()

        try:
            call_for_c(several)
        except Exception as error:  # C can't raise it
            failures[:] = [error]
            return 1
        return 0

    return evaluate


def _bind_python(call: PythonCall, functions: Mapping[int, Any], v: np.ndarray, p: np.ndarray) -> Callable[[], None]:
    """Return the call that evaluates a block from v and p into v."""
    *given, parameters = call.arguments
    columns = [v[:1], *(v[where] for where in given[1:]), p[parameters]]
    bound = bind_function(functions[call.key], columns, [v[where] for where in call.results])

    def evaluate() -> None:
        bound.call()

    return evaluate


class GroupedFunctions:
    """Ticks, and functions between them, of a large diagram: kernels for its kinds of blocks, and tables for these."""

    def __init__(self, flat: FlatDiagram, kinds: Sequence[frozenset[TickPattern]], between: Sequence[str] = ()):
        self._flat, self._stiff = flat, "slope" in between
        self._ticks = {clocks: flat.program_at(clocks) for clocks in kinds}
        self._parts = {name: flat.part_program(name) for name in between if name != "slope"}
        programs = [tick.program for tick in self._ticks.values()] + [part.program for part in self._parts.values()]
        self._blocks = BlockKinds(flat, programs)
        self._tables = dict[Kernels, tuple[dict[frozenset[TickPattern], TickTables], dict[str, PartTables]]]()
        self.operations, self.exact = self._blocks.operations, self._blocks.exact

    def text(self) -> str:
        """Return the C code of the kernels."""
        return self._blocks.source

    def find(
        self, code: CodeOfFunctions
    ) -> tuple[Mapping[frozenset[TickPattern], FunctionInC], Mapping[str, FunctionInC]]:
        """Return ticks, and functions between them, with kernels where C finds them."""
        kernels = self._blocks.find(code)
        if kernels not in self._tables:
            tables = {clocks: make_tables(tick, kernels.of) for clocks, tick in self._ticks.items()}
            self._tables[kernels] = tables, {n: make_part_tables(part, kernels.of) for n, part in self._parts.items()}
        of_ticks, of_parts = self._tables[kernels]
        tick, part = (address_of(load_runtime(), f"loopwright_grouped_{name}") for name in ("tick", "part"))
        ticks = {clocks: GroupedTick(tables, kernels, tick) for clocks, tables in of_ticks.items()}
        between: dict[str, FunctionInC] = {
            name: GroupedPart(tables, kernels, part) for name, tables in of_parts.items()
        }
        if self._stiff:
            between["slope"] = SlopesByDifferences(between["flow"], self._columns)
        return ticks, between

    def find_steps(self, code: CodeOfFunctions) -> Mapping[str, int]:
        """Return no generated steps: these are made for small rates."""
        return {}

    @cached_property
    def operations_of_rates(self) -> int:
        """Operations of one evaluation of the rates."""
        if "flow" not in self._parts:
            return 0
        part = self._parts["flow"]
        of = part.program.functions
        return sum(of[op.kernel].n_instructions() for op in part.operations if op.kernel in of)

    @cached_property
    def _columns(self) -> Columns:
        return find_columns(self._parts["flow"], self._flat.continuous)
