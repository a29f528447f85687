"""Derivatives of an exported diagram: what it puts out and the rates of its states, by everything they depend on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any

import casadi as ca

from ...fmus.export import CFunction, ComputedNumbers, LoopSlopes
from ..flat import FlatDiagram, TickPattern, speed_up

VECTORS = ("t", "x", "w", "p")


def trace_slopes(
    flat: FlatDiagram,
    acting: Sequence[frozenset[TickPattern]],
    entries: Sequence[int],
    numbers: Mapping[str, tuple[ComputedNumbers, Any]],
    start: Any,
    *,
    rates: bool,
) -> tuple[LoopSlopes | None, list[Any], dict[tuple[str, int], frozenset[tuple[str, int]]]]:
    """Return the derivatives of a diagram, their functions, and on what each value depends.

    ``numbers``: numbers that are computed from parameters, whose derivatives are those by the parameters.
    ``start``: the states at the start, of (t, x, w, p).
    ``rates``: whether there are continuous states.
    Returns: none where CasADi can't differentiate, and with algebraic loops, which C code solves.
    Returns: those of the slopes.
    Returns: by ("log", entry) or ("rates", entry), the entries of the vectors that it depends on at some kind of tick.
    """
    if flat.loops.slices or flat.in_model_exchange:
        return None, [], {}
    symbols = flat.symbols()
    given = [symbols[name] for name in VECTORS]
    sizes = [symbol.numel() for symbol in given]
    knowns = ca.MX.sym("knowns", sum(sizes))
    t, x, w, p = ca.vertsplit(knowns, [0, *accumulate(sizes)])
    for one, function in numbers.values():
        if function is not None:
            first = one.first + one.parameters
            found = function(p[one.first : first])
            p = ca.vertcat(p[:first, 0], ca.densify(found), p[first + one.count :, 0])
    forward, reverse, depends = [], [], dict[tuple[str, int], set[tuple[str, int]]]()
    owners = [(name, i) for name, size in zip(VECTORS, sizes, strict=True) for i in range(size)]
    try:
        for kind, clocks in enumerate(acting):
            tick = flat.at_tick(clocks)
            log = tick.last.fast.call([t, x, w, p])[tick.results.index("log")]
            values = [log[list(entries)]] if entries else []
            if rates:
                values.append(flat.flow.last.fast.call([t, x, w, p])[0])
            y = ca.densify(ca.vertcat(*values)) if values else ca.MX(0, 1)
            forward.append(_differentiate(f"lw_forward{kind}", y, knowns, given))
            reverse.append(_differentiate(f"lw_reverse{kind}", y, knowns, given, adjoint=True))
            labels = [("log", entry) for entry in entries] + [("rates", i) for i in range(y.numel() - len(entries))]
            sparsity = ca.Function("values", [knowns], [y]).jac_sparsity(0, 0)
            for row, column in zip(*sparsity.get_triplet(), strict=True):
                depends.setdefault(labels[row], set()).add(owners[column])
        at_start: list[Any] = []
        if start is not None:
            begun = ca.densify(start.call([t, x, w, p])[0])
            at_start = [
                _differentiate("lw_start_forward", begun, knowns, given),
                _differentiate("lw_start_reverse", begun, knowns, given, adjoint=True),
            ]
    except (RuntimeError, NotImplementedError):  # an operation that CasADi can't differentiate
        return None, [], {}
    made = LoopSlopes(
        tuple(CFunction.of(f) for f in forward),
        tuple(CFunction.of(f) for f in reverse),
        tuple(CFunction.of(f) for f in at_start),
        tuple(entries),
        y.numel() - len(entries),
    )
    return made, [*forward, *reverse, *at_start], {label: frozenset(found) for label, found in depends.items()}


def _differentiate(name: str, y: Any, knowns: Any, given: list[Any], *, adjoint: bool = False) -> Any:
    """Return the product of the Jacobian, or its transpose, with a seed, as a function of (t, x, w, p, seed)."""
    seed = ca.MX.sym("seed", y.numel() if adjoint else knowns.numel())
    product = ca.densify(ca.jtimes(y, knowns, seed, adjoint))
    inner = ca.Function(name, [knowns, seed], [product])
    found = inner.call([ca.vertcat(*given), seed], True, False)
    return speed_up(ca.Function(name, [*given, seed], [ca.densify(found[0])]))


def trace_rates(flat: FlatDiagram) -> Any:
    """Return the rates of the continuous states, as a function of (t, x, w, p)."""
    symbols = [flat.symbols()[name] for name in VECTORS]
    return speed_up(ca.Function("lw_rates", symbols, [ca.densify(flat.flow.last.fast.call(symbols)[0])]))
