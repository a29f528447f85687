"""The derivative of a large diagram's rates, by differences."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..flat import Operation, PartProgram
from .bound_functions import BoundFunction, TickStructure, at, list_vectors
from .grouped_functions import GroupedPart

_AT, _INT = ctypes.c_void_p, ctypes.c_int64


class DifferencesStructure(ctypes.Structure):
    """The derivative of the rates by differences, as C knows it."""

    _fields_ = [
        *((name, _AT) for name in ("rates", "arguments", "results", "iw", "v", "x", "dx", "before", "step", "typical")),
        *((name, _INT) for name in ("n", "colors")),
        *((name, _AT) for name in ("where", "first", "columns", "rows_first", "rows")),
    ]


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns of a derivative that are computed together.

    Columns without a common row share a color, and are moved together: the rates are evaluated once for each color.

    Attributes
    ----------
    where : ndarray of int
        Entries of x that are integrated.
    columns, first : ndarray of int32
        Columns color by color, and where each color begins.
    rows, rows_first : ndarray of int32
        Rows column by column, and where each column begins.
    """

    where: np.ndarray
    columns: np.ndarray
    first: np.ndarray
    rows: np.ndarray
    rows_first: np.ndarray

    @property
    def pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of each entry."""
        return self.rows, np.repeat(np.arange(len(self.where)), np.diff(self.rows_first))


@dataclass(frozen=True, eq=False)
class RateDifferences:
    """The derivative of the rates by the integrated states, by differences.

    Attributes
    ----------
    rates : GroupedPart
        The rates.
    columns : Columns
        The columns.
    address : int
        Address of the C function.
    """

    rates: GroupedPart
    columns: Columns
    address: int

    @property
    def operations(self) -> int:
        """Operations of one evaluation."""
        return len(self.columns.first) * self.rates.operations

    @property
    def pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of each entry."""
        return self.columns.pattern

    def bind(
        self, arguments: Sequence[np.ndarray], results: Sequence[np.ndarray], typical: np.ndarray
    ) -> BoundFunction:
        """Return it bound to vectors; ``typical`` are sizes of the states below which steps don't become smaller."""
        of, n = self.columns, len(self.columns.where)
        dx, before, step, where = np.zeros(n), np.zeros(n), np.zeros(n), of.where.astype(np.int64)
        sizes = np.ascontiguousarray(typical)
        bound = self.rates.bind(arguments, [dx])
        rates = bound.structure
        group = DifferencesStructure(
            rates=rates.evaluate,
            arguments=rates.arguments,
            results=rates.results,
            iw=rates.iw,
            v=rates.w,
            x=at(arguments[1]),
            dx=at(dx),
            before=at(before),
            step=at(step),
            typical=at(sizes),
            n=n,
            colors=len(of.first) - 1,
            where=at(where),
            first=at(of.first),
            columns=at(of.columns),
            rows_first=at(of.rows_first),
            rows=at(of.rows),
        )
        lists = list_vectors(arguments, 4), list_vectors(results, 1)
        structure = TickStructure(self.address, *map(ctypes.addressof, (*lists, group)), None)
        return BoundFunction(structure, arguments, results, [self, bound, group, lists, dx, before, step, where, sizes])


def find_columns(part: PartProgram, continuous: np.ndarray) -> Columns:
    """Return the columns of the derivative of rates by the integrated states, ``continuous`` entries of x."""
    rows = _find_rows(part, continuous)
    columns, first = color_columns(rows)
    ends = np.cumsum([0, *map(len, rows)])
    every = np.concatenate([np.zeros(0, dtype=np.int32), *rows])
    return Columns(
        continuous,
        np.array(columns, dtype=np.int32),
        np.array(first, dtype=np.int32),
        every.astype(np.int32),
        ends.astype(np.int32),
    )


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


def color_columns(rows: Sequence[np.ndarray]) -> tuple[list[int], list[int]]:
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
