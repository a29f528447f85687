"""Functions of an exported diagram besides those of its runs: its start, derivatives, guards, and computed numbers."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core import SOLVED, Block
from ...blocks.tracing import GUARDS, bundle, trace_initial, trace_numbers, traced_parameters
from ...fmus.export import CFunction, ComputedNumbers, Guards, LoopSlopes
from ..flat import (
    NONE,
    FlatDiagram,
    TickPattern,
    evaluate,
    indicators_of,
    is_true,
    sample_time_of,
    share_terms,
    speed_up,
)
from ..simulation import Port, Workspace, trace_start, values_from_left
from .open_diagram import OpenDiagram

_BEFORE = 1e-300  # s before 0, at which a source that jumps there is seen from the left
_VECTORS = ("t", "x", "w", "p")


def trace_start_values(flat: FlatDiagram, workspace: Workspace) -> tuple[Any, tuple[str, ...]]:
    """Return the start as a function (t, x, w, p) -> x, and the blocks whose start states it leaves as they are.

    It does what `find_start_values` does. Blocks whose ``initial`` can't be traced keep the states in x.

    ``workspace``: the start with the numbers at hand, with which traced results are compared.
    Returns: none if nothing is computed at the start.
    Returns: paths of blocks whose states are not computed.
    """
    left = {port: np.ravel(np.asarray(tap(None))) for port, tap in values_from_left(workspace).items()}
    functions = trace_start(flat, left)
    if not functions.inputs and functions.held is None and functions.gates is None and not flat.starts.slices:
        return None, ()
    symbols = flat.symbols()
    t, x, w, p = (symbols[name] for name in "txwp")
    before = ca.vertcat(*_sources(flat, tuple(left), symbols), t)
    here, untraced = workspace.here, list[str]()
    numbers = np.concatenate([*left.values(), here.t])
    for path, (f, names) in functions.inputs.items():
        trace, block = flat.checked.traced[path], flat.table.blocks[path]
        where, own = flat.states.slices[path], flat.parameters.slices[path]
        missing = {name: ca.MX(ca.DM.nan(max(1, _count(shape)))) for name, shape in trace.inputs.items()}
        columns = missing | dict(zip(names, f.call([x, w, p, before]), strict=True))
        found = dict(zip(names, f.call([here.x, here.w, here.p, numbers]), strict=True))
        at = {n: found[n].full().ravel() if n in found else np.full(_count(s), np.nan) for n, s in trace.inputs.items()}
        sampled = flat.table.is_sampled(flat.table.subsystem_of[path])
        initial = trace_initial(block, trace, sampled, at, here.p[own], here.x[where])
        if initial is None:
            untraced.append(path)
            continue
        x = _put(x, where, initial(*(columns[n] for n in trace.inputs), p[own]))
    for path, where in flat.starts.slices.items():
        x = _put(x, where, x[flat.states.slices[path]])
    arguments = [x, w, p, before]
    held = () if functions.held is None else functions.held.call(arguments)
    gates = () if functions.gates is None else functions.gates.call(arguments)
    for name, values in zip(flat.held.slices, held, strict=False):
        x = _put(x, flat.held.slices[name], values)
    for name, values in zip(flat.gates.slices, gates, strict=False):
        x = _put(x, flat.gates.slices[name], ca.if_else(is_true(values), 1.0, 0.0))
    made = ca.Function("lw_states_at_start", [*symbols.values()], [ca.densify(x)])
    return speed_up(made, simplify=False), tuple(untraced)


def trace_left(workspace: Workspace) -> Any:
    """Return the indicators of all events just before the start, then at it, as a function of (t, x, w, p).

    None where no source jumps at the start, or there are no events; see `domains_from_left`.
    """
    flat, left = workspace.flat, values_from_left(workspace)
    if not left or not flat.events:
        return None
    symbols = flat.symbols()
    columns = _sources(flat, tuple(left), symbols)
    taps = {port: (lambda _, column=column: column) for port, column in zip(left, columns, strict=True)}
    found = [evaluate(flat, flat.blocks, NONE, **symbols, opened=True, taps=one) for one in (taps, {})]
    g = [ca.densify(ca.MX(one)) for instant in found for one in indicators_of(instant)[0]]
    return speed_up(ca.Function("lw_indicators_at_start", [*symbols.values()], [ca.vertcat(*g)]))


def _sources(flat: FlatDiagram, ports: tuple[Port, ...], symbols: dict[str, Any]) -> list[Any]:
    """Return the outputs of some sources just before the start."""
    early = {path for path, _ in ports}
    if not early:
        return []
    order = [step for step in flat.start_order.steps if step[0] in early]
    arguments = {**symbols, "t": symbols["t"] - _BEFORE}
    found = evaluate(flat, flat.blocks, NONE, **arguments, opened=True, order=order)
    return [found.values[port] for port in ports]


def _put(x: Any, where: slice, values: Any) -> Any:
    """Return a column with some entries replaced."""
    return ca.vertcat(
        x[: where.start, 0], ca.densify(values), x[where.stop :, 0]
    )  # a column, also where x has one entry


def _count(shape: tuple[int, ...]) -> int:
    return int(np.prod(shape, dtype=int))


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
    given = [symbols[name] for name in _VECTORS]
    sizes = [symbol.numel() for symbol in given]
    knowns = ca.MX.sym("knowns", sum(sizes))
    t, x, w, p = ca.vertsplit(knowns, [0, *accumulate(sizes)])
    for one, function in numbers.values():
        if function is not None:
            first = one.first + one.parameters
            found = function(p[one.first : first])
            p = ca.vertcat(p[:first, 0], ca.densify(found), p[first + one.count :, 0])
    forward, reverse, depends = [], [], dict[tuple[str, int], set[tuple[str, int]]]()
    owners = [(name, i) for name, size in zip(_VECTORS, sizes, strict=True) for i in range(size)]
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
    symbols = [flat.symbols()[name] for name in _VECTORS]
    return speed_up(ca.Function("lw_rates", symbols, [ca.densify(flat.flow.last.fast.call(symbols)[0])]))


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
