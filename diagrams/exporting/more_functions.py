"""Further functions of an exported diagram: what must stay positive at a tick, numbers computed from parameters."""

from __future__ import annotations

import re
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core import SOLVED, Block
from ...blocks.tracing import GUARDS, bundle, trace_numbers, traced_parameters
from ...fmus.export import CFunction, ComputedNumbers, Guards
from ..flat import FlatDiagram, TickPattern, evaluate, sample_time_of, share_terms, speed_up
from .open_diagram import OpenDiagram


def trace_guards(
    flat: FlatDiagram, clocks: frozenset[TickPattern], kind: int, opened: OpenDiagram
) -> tuple[Guards, Any]:
    """Return what must stay positive at a kind of tick, and the function of their values; None without any."""
    names, texts = list[tuple[str, str]](), list[str]()

    def visit(instant: Any, path: str, inputs: Any, made: Any) -> None:
        if GUARDS in made:
            for name in flat.checked.traced[path].guards:
                names.append((opened.shown(path), name))
                texts.append(_text_of_guard(flat, path, name))

    symbols = flat.symbols()
    instant = evaluate(flat, flat.blocks, clocks, **symbols, visit=visit)
    if not names:
        return Guards(), None
    made = ca.Function(f"lw_guards_of{kind}", [*symbols.values()], [ca.densify(ca.vertcat(*instant.guards))])
    function = share_terms(speed_up(made), made.name())
    return Guards(tuple(names), CFunction.of(function), tuple(texts)), function


_NUMBERS = (0.37, 1.73, -40.0, 0.0)
"""Numbers that inputs, outputs and states have in messages of a guard: what differs between these depends on them."""
_ANY_GUARD = "The block's equations are not valid there; look up its inputs."


def _text_of_guard(flat: FlatDiagram, path: str, name: str) -> str:
    """Return what a block says where a guard of it fails, without the clauses that tell numbers of a run."""
    block, trace = flat.table.blocks[path], flat.checked.traced[path]
    if type(block).guard_error is Block.guard_error and name != SOLVED:
        return _ANY_GUARD
    said = []
    for number in _NUMBERS:
        groups = {"u": trace.inputs, "y": trace.outputs, "x": trace.states}
        u, y, x = (
            bundle(kind, {n: np.full(shape, number) if shape else number for n, shape in ports.items()})
            for kind, ports in groups.items()
        )
        try:
            said.append(re.split(r"(?<=[.;:])\s+", str(block.guard_error(name, -number, u, y, x).args[0])))
        except Exception:  # a block's own Python, with numbers that it may not know
            return _ANY_GUARD
    kept = [clause for clause in said[0] if all(clause in other for other in said)]
    return " ".join(clause[:1].upper() + clause[1:] for clause in kept) if kept else _ANY_GUARD


def trace_computed_numbers(flat: FlatDiagram) -> dict[str, tuple[ComputedNumbers, Any]]:
    """Return the blocks with numbers that are computed from parameters, and their functions; None where none is had."""
    found: dict[str, tuple[ComputedNumbers, Any]] = {}
    known: dict[tuple[int, float], Any] = {}  # equal blocks share a function
    for path, trace in flat.checked.traced.items():
        block, where = flat.table.blocks[path], flat.parameters.slices[path]
        T, count = sample_time_of(flat.table, path), sum(int(np.size(v)) for _, v in traced_parameters(block))
        computed = where.stop - where.start - count
        if computed <= 1:  # the sample time alone
            continue
        key = (id(trace), T)
        if key not in known:
            made = trace_numbers(block, trace, T, flat.p[where])
            known[key] = None if made is None else share_terms(made, f"lw_numbers{len(known)}")
        function = known[key]
        of = CFunction("", (0, 0, 0, 0)) if function is None else CFunction.of(function)
        found[path] = ComputedNumbers(where.start, count, computed, of), function
    return found
