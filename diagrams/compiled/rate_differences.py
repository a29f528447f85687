"""Derivatives by differences: of the rates of large diagrams and of those in stages, and of their algebraic loops."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..flat import Operation, PartProgram
from .bound_functions import BlockBinder, BoundFunction, FunctionInC, TickStructure, address_of, at, list_vectors
from .compiled_libraries import load_runtime
from .newton import NewtonStructure

_AT, _INT = ctypes.c_void_p, ctypes.c_int64


class _DifferencesInC(ctypes.Structure):
    _fields_ = [
        *((name, _AT) for name in ("rates", "loops", "x", "dx", "before", "step", "values", "typical")),
        *((name, _INT) for name in ("n", "colors")),
        *((name, _AT) for name in ("where", "first", "columns", "rows_first", "rows")),
    ]


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of a derivative that are computed together.

    Columns without a common row share a color, and are moved together: the rates are evaluated once for each color.
    """

    where: np.ndarray
    """Entries of x that are moved, one for each column."""
    columns: np.ndarray
    first: np.ndarray
    """Columns color by color, and where each color begins."""
    rows: np.ndarray
    rows_first: np.ndarray
    """Rows column by column, and where each column begins."""

    @classmethod
    def of(cls, where: Sequence[int] | np.ndarray, rows: Sequence[np.ndarray]) -> Columns:
        """Return the columns for entries of x, and the results that may depend on each of them."""
        columns, first = _color(rows)
        every, ends = np.concatenate([np.zeros(0), *rows]), np.cumsum([0, *map(len, rows)])
        return cls(
            np.array(where, dtype=np.int64), *(np.array(v, dtype=np.int32) for v in (columns, first, every, ends))
        )

    @classmethod
    def dense(cls, where: Sequence[int] | np.ndarray) -> Columns:
        """Return the columns where each result may depend on each entry, and there are as many of both."""
        return cls.of(where, [np.arange(len(where))] * len(where))

    @property
    def pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of each entry."""
        return self.rows, np.repeat(np.arange(len(self.where)), np.diff(self.rows_first))


@dataclass(frozen=True, eq=False)
class SlopesByDifferences(FunctionInC):
    """The derivative of a function by entries of x, by differences; with ``values`` its values come before it."""

    rates: FunctionInC
    columns: Columns
    values: bool = False
    typical: np.ndarray | None = None  # sizes of the entries of x below which steps don't become smaller; None: 1
    loops: NewtonStructure | None = None  # algebraic loops of a run, which are solved wherever entries are moved to

    @property
    def pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of each entry."""
        return self.columns.pattern

    @property
    def calls_python(self) -> bool:
        """Whether Python evaluates parts of the function."""
        return self.rates.calls_python

    def bind(
        self, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray], bind_block: BlockBinder | None = None
    ) -> BoundFunction:
        """Return it bound to vectors, for one call at a time."""
        of, n, loops = self.columns, len(self.columns.where), self.loops
        dx, before, step = np.zeros(n), np.zeros(n), np.zeros(n)
        sizes, values = np.ones(n) if self.typical is None else self.typical, np.zeros(0 if loops is None else loops.n)
        bound = self.rates.bind(arguments, [dx], bind_block)
        structure = _DifferencesInC(
            rates=ctypes.addressof(bound.structure),
            loops=None if loops is None else ctypes.addressof(loops),
            x=at(arguments[1]),
            dx=at(dx),
            before=at(before),
            step=at(step),
            values=at(values),
            typical=at(sizes),
            n=n,
            colors=len(of.first) - 1,
            where=at(of.where),
            first=at(of.first),
            columns=at(of.columns),
            rows_first=at(of.rows_first),
            rows=at(of.rows),
        )
        into = list_vectors(results, len(results))
        address = address_of(load_runtime(), "loopwright_equations" if self.values else "loopwright_slopes")
        evaluate = TickStructure(address, None, ctypes.addressof(into), ctypes.addressof(structure), None)
        kept = [self, bound, into, loops, dx, before, step, sizes]
        return BoundFunction(evaluate, arguments, results, structure, values, kept)

    def hand_over(self, to: Any) -> None:
        """Let generated code of the same function take over."""
        if self.values:  # the rates whose slope it is are among a diagram's functions, which are handed over themselves
            self.rates.hand_over(to.rates)


def find_columns(part: PartProgram, continuous: np.ndarray) -> Columns:
    """Return the columns of the derivative of rates by the integrated states, ``continuous`` entries of x."""
    return Columns.of(continuous, _find_rows(part, continuous))


def _find_rows(part: PartProgram, continuous: np.ndarray) -> list[np.ndarray]:
    """Return the rates that may depend on each integrated state."""
    program = part.program
    depends = dict[int, int]()  # of each value, the integrated states, one bit for each
    x = program.x.ids
    for j, entry in enumerate(continuous.tolist()):
        depends[x[entry]] = 1 << j
    patterns = dict[int | str, list[list[list[tuple[int, int]]]]]()
    for op in part.operations:
        masks = [[depends.get(value, 0) for value in column] for column in op.arguments]
        if not any(map(any, masks)):
            continue
        if op.kernel not in patterns:
            patterns[op.kernel] = _pattern_of(program.functions, op)
        for column, by_entry in zip(op.results, patterns[op.kernel], strict=True):
            for value, sources in zip(column, by_entry, strict=True):
                mask = 0
                for k, i in sources:
                    mask |= masks[k][i]
                if mask:
                    depends[value] = mask
    rows: list[list[int]] = [[] for _ in continuous]
    for i, value in enumerate(part.results[0]):
        mask = depends.get(value, 0)
        while mask:
            lowest = mask & -mask
            rows[lowest.bit_length() - 1].append(i)
            mask ^= lowest
    return [np.array(own, dtype=np.int32) for own in rows]


def _pattern_of(functions: Mapping[int, Any], op: Operation) -> list[list[list[tuple[int, int]]]]:
    """Return, for each result and entry of it, the arguments and their entries that it may depend on."""
    every = [(k, i) for k, column in enumerate(op.arguments) for i in range(len(column))]
    found = [[list[tuple[int, int]]() for _ in column] for column in op.results]
    function = functions[op.kernel] if isinstance(op.kernel, int) else None
    if function is None or not function.is_a("SXFunction"):
        return [[every for _ in column] for column in op.results]
    for i, into in enumerate(found):
        for k in range(function.n_in() - 1):
            if into and function.numel_in(k):
                for row, entry in zip(*function.jac_sparsity(i, k).get_triplet(), strict=True):
                    into[row].append((k, entry))
    return found


def _color(rows: Sequence[np.ndarray]) -> tuple[list[int], list[int]]:
    """Return the columns color by color, and where each begins; no two of a color have a common row."""
    taken = list[int]()  # of each color, the rows that its columns have, one bit for each
    members = list[list[int]]()
    for j, own in enumerate(rows):
        mask = sum(1 << int(row) for row in own)
        color = next((c for c, used in enumerate(taken) if not used & mask), len(taken))
        if color == len(taken):
            taken.append(0)
            members.append([])
        taken[color] |= mask
        members[color].append(j)
    return [j for one in members for j in one], [0, *np.cumsum([len(one) for one in members]).tolist()]
