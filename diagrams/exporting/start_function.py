"""The start of an exported diagram as a function: its states and held outputs, from parameters and inputs then."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from ...blocks.tracing import trace_initial
from ..flat import NONE, FlatDiagram, evaluate, indicators_of, is_true, speed_up
from ..simulation import Port, Workspace, trace_start, values_from_left

_BEFORE = 1e-300  # s before 0, at which a source that jumps there is seen from the left


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
