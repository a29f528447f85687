"""Whether outputs can be non-finite at the end of a solver's step while the states are finite."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from ..flat import NONE, FlatDiagram

_ANY = {
    ca.OP_POW,
    ca.OP_EXP,
    ca.OP_EXPM1,
    ca.OP_LOG,
    ca.OP_LOG1P,
    ca.OP_SQRT,
    ca.OP_INV,
    ca.OP_ASIN,
    ca.OP_ACOS,
    ca.OP_SINH,
    ca.OP_COSH,
    ca.OP_ACOSH,
    ca.OP_ATANH,
    ca.OP_ERFINV,
}
"""Operations that may make a value that is not finite of finite ones that move."""
_SECOND = {ca.OP_DIV, ca.OP_FMOD, ca.OP_REMAINDER}  # only where what they divide by moves
_UNKNOWN = {ca.OP_CALL, ca.OP_SOLVE, ca.OP_CONSTPOW} | _ANY | _SECOND
_CARRYING = {
    ca.OP_ADD,
    ca.OP_SUB,
    ca.OP_MUL,
    ca.OP_NEG,
    ca.OP_SQ,
    ca.OP_TWICE,
    ca.OP_FABS,
    ca.OP_SQRT,
    ca.OP_LOG,
    ca.OP_SIN,
    ca.OP_COS,
    ca.OP_TAN,
}
"""Operations whose result is not finite wherever one of their arguments is not."""
_AS_ONE = (ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT)


@dataclass
class _Computed:
    """The values that a function computes, by their place among all that are `known`."""

    suspects: set[int] = field(default_factory=set)
    made_of: list[tuple[int, int, tuple[int, ...]]] = field(default_factory=list)
    results: set[int] = field(default_factory=set)

    def required(self) -> set[int]:
        """Return the values without which no result is finite."""
        found = set(self.results)
        for value, op, arguments in reversed(self.made_of):
            if value in found:
                found |= set(arguments if op in _CARRYING else arguments[:1] if op == ca.OP_DIV else ())
        return found


def may_fail_at_steps(flat: FlatDiagram) -> bool:
    """Whether outputs can be non-finite at the end of a solver's step, where states and rates are finite.

    They can where an operation such as a division or a square root takes values that move between ticks, and the
    rates don't fail with it. Operations on parameters, and on values that are held, show at the ticks.
    """
    if flat.by_block:
        return _any_call_may_fail(flat)
    tick, flow = flat.at_tick(NONE).last.fast, flat.flow.last.fast
    if not (tick.is_a("SXFunction") and flow.is_a("SXFunction")):
        return not tick.is_a("SXFunction") and _has_any(tick)
    integrated = set(flat.continuous.tolist())

    def moves(argument: int, entry: int) -> bool:
        return argument == 0 or (argument == 1 and entry in integrated)

    known = dict[Any, int]()
    suspects = _trace(tick, moves, known).suspects
    return bool(suspects and suspects - _trace(flow, moves, known).required())


def _trace(function: Any, moves: Callable[[int, int], bool], known: dict[Any, int]) -> _Computed:
    """Follow the operations of a function; equal ones of several functions get the same place in ``known``."""
    made, slots = _Computed(), dict[int, tuple[int, bool, float | None]]()
    for k in range(function.n_instructions()):
        op, given, into = function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
        if op == ca.OP_OUTPUT:
            made.results.add(slots[given[0]][0])
            continue
        constant = function.instruction_constant(k) if op == ca.OP_CONST else None
        of = [] if op in _AS_ONE else [slots[i] for i in given]
        key = (op, constant, *given) if op in _AS_ONE else (op, *(value for value, _, _ in of))
        value = known.setdefault(key, len(known))
        moving = moves(*given) if op == ca.OP_INPUT else any(one for _, one, _ in of)
        if moving and _may_fail(op, of):
            made.suspects.add(value)
        made.made_of.append((value, op, tuple(argument for argument, _, _ in of)))
        slots[into[0]] = value, moving, constant
    return made


def _may_fail(op: int, of: Sequence[tuple[int, bool, float | None]]) -> bool:
    if op in (ca.OP_POW, ca.OP_CONSTPOW):
        exponent = of[1][2]
        return exponent is None or exponent < 0 or exponent != int(exponent)
    return op in _ANY or (op in _SECOND and of[1][1])


def _has_any(function: Any) -> bool:
    return not function.is_a("MXFunction") or any(
        function.instruction_id(k) in _UNKNOWN for k in range(function.n_instructions())
    )


def _any_call_may_fail(flat: FlatDiagram) -> bool:
    """Whether any call of a block's function between ticks may fail, whatever the rates do."""
    program = flat.program_at(NONE).program
    moving = bytearray(program.count)
    states = np.array(program.x.ids, dtype=np.int64)
    for value in (*program.t.ids, *states[flat.continuous].tolist()):
        moving[value] = 1
    of_python = {id(flat.blocks.of(path, names)) for path, names in flat.order.steps if flat.table.blocks[path].opaque}
    judged = dict[tuple[int | str, tuple[bool, ...]], bool]()
    for op in program.operations:
        columns = tuple([1 in moving[column.start : column.stop] for column in op.arguments])
        if True not in columns:
            continue
        for made in op.results:
            moving[made.start : made.stop] = b"\1" * len(made)
        key = op.kernel, columns
        if op.kernel in program.functions and key not in judged:
            function = program.functions[op.kernel]
            if op.kernel in of_python:
                judged[key] = True
            elif function.is_a("SXFunction"):
                judged[key] = bool(_trace(function, lambda i, _, c=columns: c[i], {}).suspects)  # type: ignore[misc]
            else:
                judged[key] = _has_any(function)
            if judged[key]:
                return True
    return False
