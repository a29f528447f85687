"""The functions of a diagram at a tick, between ticks, and at events: schedules of stages, traced from its blocks.

    (x_next, z, log, ok) = F(t, x, w, p)    at a tick, for every set of clocks that act
    dx = f(t, x, w, p)                      between ticks: the rates of the continuous states
    (g, open) = h(t, x, w, p)               between ticks: the indicators of all events
    x_next = J(t, x, w, p, fired)           at events

``ok`` is 1 while everything is finite, but outputs of FMUs that nothing reads (`FlatLayout.unread`), and every guard
positive. The vectors are those of `FlatLayout`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core import without_collection
from ...blocks.tracing import GUARDS
from .block_functions import BlockFunctions
from .clocks import NONE, TickPattern
from .enabling_and_triggers import above_true, choose, is_true, logic_and, logic_not, logic_or, to_number
from .evaluation import INDICATORS, JUMP, Apart, Instant, evaluate, rows
from .flat_layout import FlatLayout
from .program import Cells, PartProgram, Program, TickProgram
from .stages import Schedule
from .total_derivative import Derivative
from .trace_stages import trace_schedule
from .vectors import (
    densify,
    entries_of,
    join_columns,
    kept_states,
    log,
    loop_mismatch,
    next_x,
    outputs_of,
    plant_inputs,
    rates,
)

LARGEST = float(np.finfo(float).max)


def make_symbols(layout: FlatLayout) -> dict[str, Any]:
    """Return fresh symbols of t, x, w and p, by these names."""
    sizes = {"t": 1, "x": layout.width, "w": layout.plant_outputs.total, "p": layout.parameters.total}
    return {name: ca.MX.sym(name, size) for name, size in sizes.items()}


TracedRates = tuple[Mapping[str, Any], Any]
"""Symbols, and the rates of the integrated states as an expression of them."""


def trace_tick(
    layout: FlatLayout,
    functions: BlockFunctions,
    acting: frozenset[TickPattern],
    *,
    by_block: bool = False,
    keep: Callable[[TracedRates], None] | None = None,
) -> Schedule:
    """Return ``(t, x, w, p) -> (x_next, z, log, ok)``: a tick at which the given clocks act.

    With ``by_block`` the operations of each block are done as they are, and not simplified with those of others.
    ``keep`` is given the rates, which are made by the way.
    """
    symbols = make_symbols(layout)

    def results(apart: Apart) -> Mapping[str, Any]:
        instant = evaluate(layout, functions, acting, **symbols, apart=apart)
        if keep is not None:
            keep((symbols, rates(instant)))
        found = {"x_next": next_x(instant), "z": plant_inputs(instant), "log": log(instant)}
        counted = [_without(found["log"], layout.unread_entries), found["x_next"], found["z"]]
        if instant.mismatch:  # a block in a loop may fail: its own value isn't recorded, and the residual hides NaN
            counted.append(loop_mismatch(instant))
        sizes = (ca.norm_1(column) for column in counted if column.numel())
        ok = sum(sizes, ca.MX(0.0)) <= LARGEST  # false for any NaN or infinity
        if instant.guards:
            ok = ca.logic_and(ok, ca.mmin(ca.vertcat(*instant.guards) > 0))
        return {**found, "ok": ok}

    return trace_schedule("tick", symbols, results, by_block=by_block)


@dataclass(frozen=True, eq=False)
class GuardedTick:
    """A tick with each of its guards, for C that is read."""

    function: Any  # (t, x, w, p) -> (x_next, log, guards)
    evaluated: frozenset[str]  # the blocks that act
    guards: tuple[tuple[str, str], ...]  # block and name of each


@without_collection
def trace_guarded_tick(layout: FlatLayout, functions: BlockFunctions, acting: frozenset[TickPattern]) -> GuardedTick:
    """Return a tick at which the given clocks act with its guards one by one; see `trace_tick`."""
    symbols = make_symbols(layout)
    evaluated: set[str] = set()
    guards: list[tuple[str, str]] = []

    def visit(instant: Instant, path: str, inputs: dict[str, Any], made: dict[str, Any]) -> None:
        evaluated.add(path)
        if GUARDS in made:
            guards.extend((path, name) for name in functions.traced[path].guards)

    instant = evaluate(layout, BlockFunctions(functions.traced, inlined=True), acting, **symbols, visit=visit)
    results = {"x_next": next_x(instant), "log": log(instant), "guards": join_columns(instant.guards)}
    made = [ca.densify(ca.MX(column)) for column in results.values()]
    function = ca.Function("tick", [*symbols.values()], made, [*symbols], [*results])
    return GuardedTick(function, frozenset(evaluated), tuple(guards))


def _without(column: Any, entries: np.ndarray) -> Any:
    """Return a column without some of its entries."""
    if not entries.size:
        return column
    return column[np.setdiff1d(np.arange(column.numel()), entries).tolist()]


@without_collection
def trace_tick_program(layout: FlatLayout, functions: BlockFunctions, acting: frozenset[TickPattern]) -> TickProgram:
    """Return a tick at which the given clocks act as a program: the calls of block functions that it consists of."""
    program = Program((layout.width, layout.plant_outputs.total, layout.parameters.total))
    instant = evaluate(layout, functions, acting, program.t, program.x, program.w, program.p)
    made, taken = zip(*instant.mismatch, strict=True) if instant.mismatch else ((), ())
    flow = program.join([rates(instant)]).ids if acting == NONE else None
    return TickProgram(
        program,
        x_next=program.join([next_x(instant)]).ids,
        z=plant_inputs(instant).ids,
        log=program.join([instant.w, *outputs_of(instant), kept_states(instant)]).ids,
        guards=program.join(instant.guards).ids,
        mismatch=(program.join(made).ids, program.join(taken).ids) if layout.loops.slices else None,
        rates=flow,
        unread=layout.unread_entries,
    )


def trace_between(layout: FlatLayout, functions: BlockFunctions, name: str) -> Schedule:
    """Return a function between ticks; see `results_between`."""
    symbols = make_symbols(layout)
    if name == "jump":
        symbols["fired"] = ca.MX.sym("fired", len(layout.events))

    def results(apart: Apart) -> Mapping[str, Any]:
        instant = evaluate(layout, functions, NONE, **symbols, apart=apart)
        return {result: join_columns(columns) for result, columns in results_between(name, instant).items()}

    return trace_schedule(name, symbols, results)


@without_collection
def trace_part_program(layout: FlatLayout, functions: BlockFunctions, name: str) -> PartProgram:
    """Return a function between ticks as a program; see `results_between`."""
    sizes = (layout.width, layout.plant_outputs.total, layout.parameters.total)
    program = Program(sizes, len(layout.events) if name == "jump" else 0)
    fired = program.more if name == "jump" else None
    instant = evaluate(layout, functions, NONE, program.t, program.x, program.w, program.p, fired=fired)
    return PartProgram.of(program, *map(program.join, results_between(name, instant).values()))


def results_between(name: str, instant: Instant) -> dict[str, list[Any]]:
    """Return the results of a function between ticks, each by its name as columns one below the other.

    ``"flow"`` has the rates dx of the entries of x that are integrated; ``"driven"`` z, the inputs of what is stepped
    between ticks; ``"indicators"`` g, those of all events, and open, 1 where the subsystems around them are open;
    ``"jump"`` x_next, the states after the events that fire, each of which sees the instant before them all. A block in
    model exchange is asked at a jump whatever fires: it has its own events.
    """
    if name == "flow":
        return {"dx": [rates(instant)]}
    if name == "driven":
        return {"z": [plant_inputs(instant)]}
    if name == "indicators":
        g, opened = indicators_of(instant)
        return {"g": g, "open": opened}
    assert name == "jump"
    _let_fire(instant)
    return {"x_next": [next_x(instant)]}


def trace_model_exchange(layout: FlatLayout, functions: BlockFunctions) -> Schedule:
    """Return ``(t, x, w, p, log) -> z`` between ticks; sampled blocks put out what they did at the last tick."""
    symbols = {**make_symbols(layout), "log": ca.MX.sym("log", layout.log.total)}

    def results(apart: Apart) -> Mapping[str, Any]:
        instants = {name: symbol for name, symbol in symbols.items() if name != "log"}
        return {"z": plant_inputs(evaluate(layout, functions, NONE, **instants, apart=apart, kept=symbols["log"]))}

    return trace_schedule("exchange", symbols, results)


def trace_output(layout: FlatLayout, functions: BlockFunctions, port: tuple[str, str]) -> Schedule:
    """Return ``(t, x, w, p) -> y``: an output between ticks, without entries where nothing evaluates it then."""
    symbols = make_symbols(layout)

    def results(apart: Apart) -> Mapping[str, Any]:
        return {"y": evaluate(layout, functions, NONE, **symbols, apart=apart).values.get(port, ca.MX(0, 1))}

    return trace_schedule("output", symbols, results)


def indicators_of(instant: Instant) -> tuple[list[Any], list[Any]]:
    """Return the indicators of all events at an instant, and 1 where the subsystems around them are open."""
    layout = instant.layout
    g, opened, blocks = [], [], dict[str, Any]()
    for event in layout.events:
        if event.subsystem:
            g.append(above_true(instant.control(event.path)))
            gate: Any = True
            for subsystem in layout.table.gates(event.path.rpartition(".")[0]):
                gate = logic_and(gate, instant.is_open(subsystem))
        else:
            path = event.path
            if path not in blocks:
                blocks[path] = entries_of(instant.events_of(path, INDICATORS))
            g.append(blocks[path][list(layout.table.blocks[path].events).index(event.name)])
            gate = instant.gate_of(path)
        if isinstance(gate, bool):
            gate = to_number(gate) if isinstance(instant.t, Cells) else ca.MX(float(gate))
        opened.append(gate)
    return g, opened


def _let_fire(instant: Instant) -> None:
    """Put the states of an instant to those after the events that fire there."""
    layout, x, fired = instant.layout, instant.x, instant.fired
    states, starts = layout.states.slices, layout.starts.slices
    own: dict[str, list[int]] = {path: [] for path in layout.in_model_exchange}
    for i, event in enumerate(layout.events):
        own.setdefault(event.path, []).append(i)
    for path, indices in own.items():
        if path in layout.table.controls:
            continue
        each = [fired[i : i + 1] for i in indices]
        after = instant.events_of(path, JUMP, join_columns(each))
        acts = instant.gate_of(path)
        if path not in layout.in_model_exchange:  # those look at every event themselves
            acts = logic_and(acts, reduce(logic_or, map(is_true, each)))
        instant.new[path] = choose(acts, densify(after), rows(x, states[path]))
    for i, event in enumerate(layout.events):
        if event.subsystem and event.name == "enable":
            mode = rows(x, layout.gates.slices[event.path])
            turned = is_true(fired[i : i + 1])
            instant.gates[event.path] = choose(turned, logic_not(is_true(mode)), mode)
            if layout.table.subsystems[event.path].when == "reset":
                opens = logic_and(turned, logic_not(is_true(mode)))
                for path, where in starts.items():
                    if event.path in layout.around[layout.table.subsystem_of[path]]:
                        old = instant.new.get(path, rows(x, states[path]))
                        instant.new[path] = choose(opens, rows(x, where), old)


def trace_loops(layout: FlatLayout, functions: BlockFunctions, acting: frozenset[TickPattern]) -> Derivative | None:
    """Return ``(t, x, w, p) -> (r, ∂r/∂v)``: what came round the algebraic loops less what was taken, v.

    The values v are the entries `FlatLayout.active_loops` of x. None where no torn port acts.
    """
    active = layout.active_loops(acting)
    if not active:
        return None
    symbols = make_symbols(layout)

    def results(apart: Apart) -> Mapping[str, Any]:
        return {"r": loop_mismatch(evaluate(layout, functions, acting, **symbols, apart=apart))}

    return Derivative(trace_schedule("loops", symbols, results), [("x", active)])


def differentiate_flow_with_loops(layout: FlatLayout, functions: BlockFunctions) -> Derivative:
    """Return ``(t, x, w, p) -> (∂f/∂x, ∂f/∂v, ∂r/∂x, ∂r/∂v)`` for loops with values v and residual r(x, v) = 0.

    By the implicit function theorem the derivative of the rates f is ∂f/∂x − ∂f/∂v (∂r/∂v)⁻¹ ∂r/∂x.
    """
    symbols = make_symbols(layout)

    def results(apart: Apart) -> Mapping[str, Any]:
        instant = evaluate(layout, functions, NONE, **symbols, apart=apart)
        return {"dx": rates(instant), "r": loop_mismatch(instant)}

    by = [("x", layout.continuous.tolist()), ("x", layout.active_loops(NONE))]
    return Derivative(trace_schedule("flow_with_loops", symbols, results), by, values=False)
