"""A tick as a list of calls: which block function takes which values, and where its results go.

`evaluate` goes over the blocks with `Cells` in place of symbols. Nothing is computed: every call of a block's function,
and every choice by a gate, is written down as an operation on numbered values. Unlike one CasADi function of the whole
tick this stays small with many blocks, as equal blocks share a function, and it is where grouped code is made from.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

Ids = range | tuple[int, ...]

COPY, TRUE_OF, AND, OR, NOT, CHOOSE, LESS = "copy", "is_true", "and", "or", "not", "choose", "less_true"
"""Operations on single values, next to the calls of block functions."""
_NOTHING = range(0)


class Cells:
    """A column of numbered values of a program, in place of a column of symbols."""

    __slots__ = ("ids", "program")

    def __init__(self, program: Program, ids: Ids):
        self.program, self.ids = program, ids

    def __getitem__(self, where: slice | list[int]) -> Cells:
        return Cells(self.program, self.ids[where] if isinstance(where, slice) else as_ids(self.ids[i] for i in where))

    def numel(self) -> int:
        """Return the number of entries."""
        return len(self.ids)


@dataclass(frozen=True, slots=True)
class Operation:
    """A call of a block's function, or an operation on single values."""

    kernel: int | str  # key of the function in `Program.functions`, or one of the operations above
    arguments: tuple[range, ...]  # a range a column: first time, last parameters; empty of single ones
    results: tuple[range, ...]


@dataclass(eq=False)
class Program:
    """Operations on numbered values: first those of t, x, w and p, then constants and results as they come."""

    widths: tuple[int, int, int]
    further: int = 0  # entries of ``more``, such as the events that fire
    functions: dict[int, Any] = field(default_factory=dict)
    operations: list[Operation] = field(default_factory=list)  # in an order in which they can be done
    constants: dict[int, float] = field(default_factory=dict)  # by the value that holds them
    columns: list[range] = field(default_factory=list)  # consecutive values

    def __post_init__(self) -> None:
        self.count = 0
        self.t, self.x, self.w, self.p, self.more = (Cells(self, self._new(n)) for n in (1, *self.widths, self.further))
        self.given = self.count
        self._constants: dict[bytes, range] = {}
        self._sizes: dict[int, list[int]] = {}

    def _new(self, size: int) -> range:
        self.count += size
        return range(self.count - size, self.count)

    def _make(self, size: int) -> range:
        made = self._new(size)
        if size:
            self.columns.append(made)
        return made

    def constant(self, values: Any) -> range:
        """Return the values that hold some numbers."""
        numbers = np.asarray(values, dtype=float)
        key = numbers.tobytes()
        if key not in self._constants:
            made = self._constants[key] = self._make(numbers.size)
            self.constants.update(zip(made, numbers.ravel().tolist(), strict=True))
        return self._constants[key]

    def ids(self, column: Any) -> Ids:
        """Return the values of a column; numbers become constants."""
        return column.ids if isinstance(column, Cells) else self.constant(column)

    def call(self, function: Any, arguments: Sequence[Any]) -> list[Cells]:
        """Write down the call of a block's function."""
        key = id(function)
        if key not in self._sizes:
            self.functions[key] = function
            self._sizes[key] = [function.numel_out(i) for i in range(function.n_out())]
        given = tuple([self._together(self.ids(column)) for column in arguments])
        results = tuple([self._make(size) for size in self._sizes[key]])
        self.operations.append(Operation(key, given, results))
        return [Cells(self, made) for made in results]

    def apply(self, name: str, *columns: Any) -> Cells:
        """Write down an operation on single values for each entry of columns; one value may go with all entries."""
        ids = [self.ids(column) for column in columns]
        made = self._make(max(map(len, ids)))
        for i, result in enumerate(made):
            given = [self._one(part[i if len(part) > 1 else 0]) for part in ids]
            self.operations.append(Operation(name, (_NOTHING, *given, _NOTHING), (self._one(result),)))
        return Cells(self, made)

    @staticmethod
    def _one(value: int) -> range:
        return range(value, value + 1)

    def _together(self, ids: Ids) -> range:
        """Return these values, or copies of them, as consecutive ones."""
        if isinstance(ids, range):
            return ids
        copied = self.apply(COPY, Cells(self, ids)).ids
        assert isinstance(copied, range)
        return copied

    def join(self, columns: Iterable[Any]) -> Cells:
        """Return columns one below the other."""
        return Cells(self, as_ids(value for column in columns for value in self.ids(column)))


def as_ids(values: Iterable[int]) -> Ids:
    """Return values as a range where they are consecutive."""
    found = tuple(values)
    first = found[0] if found else 0
    whole = range(first, first + len(found))
    return whole if found == tuple(whole) else found


@dataclass(frozen=True, eq=False)
class TickProgram:
    """A tick as a program."""

    program: Program
    x_next: Ids
    z: Ids
    log: Ids  # without the residual
    guards: Ids
    mismatch: tuple[Ids, Ids] | None  # what came round algebraic loops, and what was taken
    rates: Ids | None = None  # of the integrated states, where no clock acts
    # int32: entries of the log that may be no finite numbers
    unread: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int32))


@dataclass(frozen=True, eq=False)
class PartProgram:
    """A function between ticks as a program: rates, indicators, or states after events."""

    program: Program
    operations: list[Operation]  # those that the results need, in an order
    results: tuple[Ids, ...]

    @classmethod
    def of(cls, program: Program, *results: Cells) -> PartProgram:
        """Return the part of a program that some results need."""
        needed = bytearray(program.count)
        for value in (value for cells in results for value in cells.ids):
            needed[value] = 1
        kept = list[Operation]()
        for op in reversed(program.operations):
            if any(needed[value] for column in op.results for value in column):
                kept.append(op)
                for value in (value for column in op.arguments for value in column):
                    needed[value] = 1
        return cls(program, kept[::-1], tuple(cells.ids for cells in results))
