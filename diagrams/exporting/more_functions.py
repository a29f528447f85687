"""Further functions of an exported diagram: what must stay positive at a tick, numbers computed from parameters."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ...blocks.tracing import GUARDS, trace_numbers, traced_parameters
from ...fmus.export import CFunction, ComputedNumbers, Guards
from ..flat import FlatDiagram, TickPattern, evaluate, sample_time_of, share_terms, speed_up
from .open_diagram import OpenDiagram


def trace_guards(
    flat: FlatDiagram, clocks: frozenset[TickPattern], kind: int, opened: OpenDiagram
) -> tuple[Guards, Any]:
    """Return what must stay positive at a kind of tick, and the function of their values; None without any."""
    names: list[tuple[str, str]] = []

    def visit(instant: Any, path: str, inputs: Any, made: Any) -> None:
        if GUARDS in made:
            names.extend((opened.shown(path), name) for name in flat.checked.traced[path].guards)

    symbols = flat.symbols()
    instant = evaluate(flat, flat.blocks, clocks, **symbols, visit=visit)
    if not names:
        return Guards(), None
    made = ca.Function(f"lw_guards_of{kind}", [*symbols.values()], [ca.densify(ca.vertcat(*instant.guards))])
    function = share_terms(speed_up(made), made.name())
    return Guards(tuple(names), CFunction.of(function)), function


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
