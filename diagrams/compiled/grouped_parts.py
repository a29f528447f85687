"""Rates, indicators and jumps of large diagrams as grouped code, and the derivative of the rates by differences."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..flat import Operation, PartProgram
from .grouping import PartTables

PythonTick = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int64)
"""A call from C that lets Python evaluate a block."""
_AT, _INT = ctypes.c_void_p, ctypes.c_int64


class PartStructure(ctypes.Structure):
    """A function between ticks, as C knows it."""

    _fields_ = [
        *((name, _AT) for name in ("runs", "rows")),
        *((name, _INT) for name in ("count", "states", "outside", "more")),
        ("where", _AT),
        ("lengths", _INT * 2),
        ("python", PythonTick),
    ]


class DifferencesStructure(ctypes.Structure):
    """The derivative of the rates by differences, as C knows it."""

    _fields_ = [
        *((name, _AT) for name in ("rates", "arguments", "results", "iw", "v", "x", "dx", "before", "step", "typical")),
        *((name, _INT) for name in ("n", "colors")),
        *((name, _AT) for name in ("where", "first", "columns", "rows_first", "rows")),
    ]


@dataclass(frozen=True, eq=False)
class GroupedPart:
    """A function between ticks as runs of equal blocks.

    Attributes
    ----------
    tables : PartTables
        Where the values of each block stand.
    functions : mapping
        CasADi functions of the blocks that Python evaluates, by key.
    operations : int
        Operations of one evaluation.
    address : int
        Address of the C function that goes over the tables.
    """

    tables: PartTables
    functions: Mapping[int, Any]
    operations: int
    address: int

    @property
    def pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of each entry: none, it is no derivative."""
        return np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.int32)


@dataclass(frozen=True, eq=False)
class Differences:
    """The derivative of the rates by the integrated states, by differences.

    Columns without a common row share a color, and are moved together: the rates are evaluated once for each color.

    Attributes
    ----------
    rates : GroupedPart
        The rates.
    address : int
        Address of the C function.
    where : ndarray of int
        Entries of x that are integrated.
    columns, first : ndarray of int32
        Columns color by color, and where each color begins.
    rows, rows_first : ndarray of int32
        Rows column by column, and where each column begins.
    """

    rates: GroupedPart
    address: int
    where: np.ndarray
    columns: np.ndarray
    first: np.ndarray
    rows: np.ndarray
    rows_first: np.ndarray

    @property
    def operations(self) -> int:
        """Operations of one evaluation."""
        return len(self.first) * self.rates.operations

    @property
    def pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """Row and column of each entry."""
        return self.rows, np.repeat(np.arange(len(self.where)), np.diff(self.rows_first))


def find_differences(part: PartProgram, continuous: np.ndarray, rates: GroupedPart, address: int) -> Differences:
    """Return the derivative of the rates by differences."""
    rows = _find_rows(part, continuous)
    columns, first = color_columns(rows)
    ends = np.cumsum([0, *map(len, rows)])
    every = np.concatenate([np.zeros(0, dtype=np.int32), *rows])
    return Differences(
        rates,
        address,
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
