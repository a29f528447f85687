"""Programs of the virtual machine: CasADi functions of scalar operations, sorted into runs of one operation."""

from __future__ import annotations

import ctypes
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

_INPUT, _OUTPUT = 0, 1


class _ProgramStructure(ctypes.Structure):
    _fields_ = [("runs", ctypes.c_int64), *((name, ctypes.c_void_p) for name in ("code", "generated", "iw", "w"))]


class BlockProgramStructure(ctypes.Structure):
    """A block's function as C knows it; see `machine.c`."""

    _fields_ = [
        ("runs", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("code", "values")),
        *((name, ctypes.c_int32) for name in ("width", "row")),
        ("columns", ctypes.c_void_p),
        ("arguments", ctypes.c_int32),
    ]


@dataclass(frozen=True, eq=False)
class MachineProgram:
    """A function as a list of runs, one behind the other; see `machine.c`."""

    runs: int
    code: np.ndarray  # int32
    start: np.ndarray  # the values before the first evaluation: constants, and zeros

    def bind(self) -> tuple[ctypes.Structure, np.ndarray]:
        """Return the program as C knows it, and memory for one use of it at a time; valid as long as both live."""
        return _ProgramStructure(self.runs, self.code.ctypes.data), self.start.copy()


@dataclass(frozen=True, eq=False)
class BlockProgram:
    """A block's function as a program for several blocks at a time."""

    program: MachineProgram  # each value has ``width`` places
    width: int
    columns: np.ndarray  # int32: of each argument, then result, its entry of a row; -1: none
    arguments: int  # their number; the last one is the parameters

    def bind(self) -> tuple[BlockProgramStructure, np.ndarray]:
        """Return it as C knows it, and memory for one use of it at a time; valid as long as both live."""
        values, row = self.program.start.copy(), int(self.columns.max(initial=-1)) + 1
        structure = BlockProgramStructure(
            self.program.runs,
            self.program.code.ctypes.data,
            values.ctypes.data,
            self.width,
            row,
            self.columns.ctypes.data,
            self.arguments,
        )
        return structure, values


def make_program(function: Any, names: Sequence[str], width: int = 1) -> MachineProgram | None:
    """Return a CasADi function of scalar operations as a program; None if it has one that the machine doesn't have.

    Every operation writes to a place that nothing else is written to. So operations may be done in any order in which
    the operands come first; those of one kind are done together where that is possible. ``names`` are those of the
    machine's operations, by their codes; each value has ``width`` places.
    """
    codes = {getattr(ca, f"OP_{name}"): code for code, name in enumerate(names)}
    place: dict[int, int] = {}  # of the last value that was written to a place of CasADi's memory
    start: list[float] = []
    rows: list[tuple[tuple[int, ...], tuple[int, ...]]] = []  # of each operation: its kind, and its row
    made: list[int] = []  # by place: the operation that writes there; -1: a constant
    for k in range(function.n_instructions()):
        op = function.instruction_id(k)
        given, written = function.instruction_input(k), function.instruction_output(k)
        if op == ca.OP_CONST:
            place[written[0]] = len(start)
            start.append(function.instruction_constant(k))
            made.append(-1)
            continue
        if op not in codes:
            return None
        code = codes[op]
        if code == _OUTPUT:
            rows.append(((code, written[0]), (place[given[0]], written[1])))
            continue
        operands = () if code == _INPUT else tuple(place[i] for i in given)
        place[written[0]] = len(start)
        kind: tuple[int, ...] = (code, given[0]) if code == _INPUT else (code,)
        row: tuple[int, ...] = (len(start), given[1]) if code == _INPUT else (len(start), *operands)
        made.append(len(rows))
        start.append(0.0)
        rows.append((kind, row))
    runs = _sort(rows, made)
    code_of: list[int] = []
    for kind, members in runs:
        code_of += [kind[0], len(members), *kind[1:]]
        transfers = kind[0] in (_INPUT, _OUTPUT)  # the second number is an entry of a vector
        for i in members:
            first, *others = rows[i][1]
            code_of += [width * first, *(others if transfers else [width * place for place in others])]
    return MachineProgram(len(runs), np.array(code_of, dtype=np.int32), np.repeat(start or [0.0], width))


def _sort(
    rows: Sequence[tuple[tuple[int, ...], tuple[int, ...]]], made: Sequence[int]
) -> list[tuple[tuple[int, ...], list[int]]]:
    """Return the operations in runs of one kind: of the kinds that can be next, the one with most operations is."""
    waits, readers = [0] * len(rows), defaultdict[int, list[int]](list)
    for i, (kind, row) in enumerate(rows):
        operands = () if kind[0] == _INPUT else row[:1] if kind[0] == _OUTPUT else row[1:]
        for before in {made[v] for v in operands} - {-1}:
            waits[i] += 1
            readers[before].append(i)
    ready = defaultdict[tuple[int, ...], list[int]](list)
    for i, (kind, _) in enumerate(rows):
        if not waits[i]:
            ready[kind].append(i)
    found = []
    while ready:
        kind = max(ready, key=lambda k: (k[0] != _OUTPUT, len(ready[k]), tuple(-v for v in k)))
        members = ready.pop(kind)
        for i in members:  # what becomes ready by these joins them, if it is of their kind
            for reader in readers[i]:
                waits[reader] -= 1
                if not waits[reader]:
                    (members if rows[reader][0] == kind else ready[rows[reader][0]]).append(reader)
        found.append((kind, members))
    return found
