"""One evaluation of all blocks at an instant, in the order of evaluation: with symbols, or with numbers.

Everything that a diagram does is read off such an `Instant`: its outputs, the next states, the rates between ticks, the
indicators of events. With symbols it gives the functions that are run, differentiated and compiled; with numbers it
finds out who made a value that is not finite.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core import Block, Layout, SimulationError, Wanted
from ...blocks.tracing import GUARDS, NEXT, size
from ..wiring import OrderStep, Wire, join
from .block_functions import BlockFunctions, call_block
from .clocks import TickPattern
from .enabling_and_triggers import choose, is_true, logic_and, logic_not, logic_or, to_number
from .flat_layout import FlatLayout
from .program import Cells

INDICATORS, JUMP = "indicators", "jump"
"""Names of the equations of a block's events, next to its outputs, `NEXT` and `GUARDS`."""

SMALLEST = float(np.finfo(float).tiny)
"""Time in s that is above 0, and that no other time of a run is changed by."""

Apart = Callable[["Instant", str, tuple[str, ...], Any, Sequence[Any]], list[Any]]
"""Evaluates a block apart from the others: called with the instant, the block's path, the names of the equations
that are wanted, its states and its inputs as columns, it returns a column for each name."""


def evaluate(
    layout: FlatLayout,
    functions: BlockFunctions,
    acting: frozenset[TickPattern],
    t: Any,
    x: Any,
    w: Any,
    p: Any,
    *,
    fired: Any = None,
    opened: bool = False,
    begun: bool = False,
    order: Iterable[OrderStep] | None = None,
    before: Callable[[str, dict[str, Any]], None] | None = None,
    visit: Callable[[Instant, str, dict[str, Any], dict[str, Any]], None] | None = None,
    taps: Mapping[tuple[str, str], Callable[[Any], Any]] | None = None,
    apart: Apart | None = None,
    kept: Any = None,
) -> Instant:
    """Evaluate all blocks at an instant.

    Parameters
    ----------
    layout : FlatLayout
        Places of everything in the vectors.
    functions : BlockFunctions
        The functions of the blocks.
    acting : frozenset of TickPattern
        The clocks that tick; without any it is an instant between ticks.
    t, x, w, p : columns
        CasADi's symbols, NumPy's numbers, or the `Cells` of a program.
    fired : column, optional
        Which of the diagram's events fire; without it none does.
    opened : bool
        Evaluate every subsystem as if it acted.
    begun : bool
        Evaluate blocks with a branch of their start (`after_start`) just after t, as linear models take them.
    order : iterable of OrderStep, optional
        Another order than that of a tick.
    before, visit : callable, optional
        ``before(path, inputs)`` is called ahead of each block, ``visit(instant, path, inputs, made)`` after it, with
        what it has made by name.
    taps : mapping, optional
        By port: a function that gives what its consumers get, from what is put out there.
    apart : callable, optional
        Evaluates the blocks of `FlatLayout.apart`; required where there are any.
    kept : column, optional
        Outputs at the last tick, as `FlatLayout.log` lays them out: those of blocks that do not act.
    """
    instant = Instant(
        layout,
        functions,
        acting,
        t,
        x,
        w,
        p,
        fired=fired,
        opened=opened,
        begun=begun,
        taps=taps or {},
        apart=apart,
        kept=kept,
    )
    instant.run(layout.order.steps if order is None else order, before, visit)
    return instant


@dataclass(eq=False)
class Instant:
    """The values of all blocks at an instant, as flat columns; see `evaluate`."""

    layout: FlatLayout
    functions: BlockFunctions
    acting: frozenset[TickPattern]
    t: Any
    x: Any
    w: Any
    p: Any
    _: KW_ONLY
    fired: Any = None
    opened: bool = False
    begun: bool = False
    taps: Mapping[tuple[str, str], Callable[[Any], Any]] = field(default_factory=dict)
    apart: Apart | None = None
    kept: Any = None
    values: dict[tuple[str, str], Any] = field(default_factory=dict, init=False)  # columns of all outputs, by port
    # Outputs at tapped ports, as they were before the tap.
    returned: dict[tuple[str, str], Any] = field(default_factory=dict, init=False)
    new: dict[str, Any] = field(default_factory=dict, init=False)  # next states of the blocks that act, by path
    rates: dict[str, Any] = field(default_factory=dict, init=False)  # by path
    held: dict[str, Any] = field(default_factory=dict, init=False)  # outputs that are held from now on, by dotted port
    # Of enabled and triggered subsystems: what they remember of their control.
    gates: dict[str, Any] = field(default_factory=dict, init=False)
    guards: list[Any] = field(default_factory=list, init=False)  # must be positive
    # Of each torn port: what came round, and what was taken.
    mismatch: list[tuple[Any, Any]] = field(default_factory=list, init=False)
    # Equations of the block at hand that are evaluated again, later.
    provisional: set[str] = field(default_factory=set, init=False)
    _open: dict[str, Any] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self._events = {(e.path, e.name): i for i, e in enumerate(self.layout.events)}

    def run(
        self,
        order: Iterable[OrderStep],
        before: Callable[[str, dict[str, Any]], None] | None,
        visit: Callable[[Instant, str, dict[str, Any], dict[str, Any]], None] | None,
    ) -> None:
        """Evaluate all blocks; called once, by `evaluate`."""
        layout, table, traced = self.layout, self.layout.table, self.functions.traced
        acts = {path: self._acts(table.subsystem_of[path]) for path in traced}
        torn = self._put_known(acts)
        steps = [*order]
        last = {(path, name): i for i, (path, names) in enumerate(steps) for name in names}
        for i, (path, names) in enumerate(steps):
            if not acts[path]:
                continue
            trace = traced[path]
            inputs = {q: self.source(path, q) if self._is_made(path, q) else None for q in trace.inputs}
            if before is not None:
                before(path, inputs)
            made = dict(zip(names, self._evaluate(path, names, inputs), strict=True))
            self.provisional = {name for name in names if last[path, name] != i}
            if visit is not None:
                visit(self, path, inputs, made)
            gate = self.gate_of(path)
            for name, column in made.items():
                if name == NEXT:
                    self._advance(path, column, gate)
                elif name == GUARDS:
                    self.guards += [choose(gate, column, np.ones(len(trace.guards)))] if trace.guards else []
                else:
                    self._output(path, name, column, gate, torn)
        # Subsystems without blocks remember their control, too.
        for subsystem in layout.gates.slices:
            if self._acts(subsystem):
                self.is_open(subsystem)
        for path in layout.starts.slices:  # blocks of another rate than the subsystem that resets them
            if not acts[path] and any(self._resets(subsystem) for subsystem in layout.around[table.subsystem_of[path]]):
                self.new[path] = self._state(path)

    def _put_known(self, acts: Mapping[str, bool]) -> dict[tuple[str, str], Any]:
        """Put the outputs that are known before any block is evaluated; return those at which loops are torn.

        These are the outputs of plants, those that blocks hold which don't act (or put out at the last tick), and the
        values of algebraic loops.
        """
        layout = self.layout
        for name, where in layout.plant_outputs.slices.items():
            self._put(layout.ports[name], rows(self.w, where))
        for name, where in layout.held.slices.items():
            path, port = layout.ports[name]
            if not acts[path]:
                self._put((path, port), rows(self.x, where))
        for name, where in layout.log.slices.items() if self.kept is not None else ():
            path, port = layout.ports[name]
            if path in acts and not acts[path] and (path, port) not in self.values:
                self._put((path, port), rows(self.kept, where))
        torn = {}
        for name, where in layout.loops.slices.items():
            path, port = layout.ports[name]
            if acts[path]:
                torn[path, port] = rows(self.x, where)
                self._put((path, port), torn[path, port])
        return torn

    def _acts(self, subsystem: str) -> bool:
        clock = self.layout.clocks.get(subsystem)
        return clock is None or self.opened or clock in self.acting

    # --- one block ---------------------------------------------------------------------------------------------------

    def source(self, path: str, port: str) -> Any:
        """Return the flat column at an input of a block, or of what is stepped between ticks."""
        wire = self.layout.table.wires.get((path, port))
        if wire is None:
            default = self.layout.table.blocks[path].inputs[port].default
            return np.ravel(np.asarray(default))
        return self.part(wire)

    def part(self, wire: Wire) -> Any:
        """Return the part of an output's flat column that a wire takes."""
        column = self.values[wire.block, wire.port]
        if wire.index is None:
            return column
        shape = self.layout.log.shapes[join(wire.block, wire.port)]
        index = np.ravel(wire.entries(shape))
        return column[index.tolist()] if not isinstance(column, np.ndarray) else column[index]

    def _is_made(self, path: str, port: str) -> bool:
        """Whether the signal at an input has been computed, or is a default."""
        wire = self.layout.table.wires.get((path, port))
        return wire is None or (wire.block, wire.port) in self.values

    def events_of(self, path: str, name: str, *more: Any) -> Any:
        """Return the column of a block's `INDICATORS`, or of its states after a `JUMP`; ``more``: which events fire."""
        trace = self.functions.traced[path]
        t, state, inputs, p = self._arguments(path, {q: self.source(path, q) for q in trace.inputs})
        if path in self.layout.apart:
            return self._call_apart(path, (name,), state, [*inputs, *more])[0]
        if isinstance(t, Cells):
            return call_block(self.functions.of_events(path, name), [t, state, *inputs, *more, p])[0]
        function = trace.indicators if name == INDICATORS else trace.jump
        return call_block(function, [t, state, *inputs, p, *more])[0]

    def _evaluate(self, path: str, names: tuple[str, ...], inputs: dict[str, Any]) -> list[Any]:
        t, state, columns, p = self._arguments(path, inputs)
        if path in self.layout.apart:
            return self._call_apart(path, names, state, columns)
        made = call_block(self.functions.of(path, names), [t, state, *columns, p], inlined=self.functions.inlined)
        return [m if isinstance(m, Cells) or m.is_dense() else ca.densify(m) for m in made]

    def _arguments(self, path: str, inputs: dict[str, Any]) -> tuple[Any, Any, list[Any], Any]:
        """Return t, x, the inputs and p of a block, as its functions take them.

        Inputs that are not computed yet are not used by the outputs that are; zeros replace them.
        """
        shapes = self.functions.traced[path].inputs
        columns = [np.zeros(size(s)) if inputs[q] is None else inputs[q] for q, s in shapes.items()]
        return self._time(path), self._state(path), columns, rows(self.p, self.layout.parameters.slices[path])

    def _time(self, path: str) -> Any:
        return just_after(self.t, self.layout.table.blocks[path]) if self.begun else self.t

    def _call_apart(self, path: str, names: tuple[str, ...], state: Any, inputs: Sequence[Any]) -> list[Any]:
        if self.apart is None:
            raise no_evaluator(path)
        return self.apart(self, path, names, state, inputs)

    def size_of(self, path: str, name: str) -> int:
        """Return the number of entries of an output of a block, or of another of its equations."""
        trace = self.functions.traced[path]
        if name in trace.outputs:
            return size(trace.outputs[name])
        if name == GUARDS:
            return len(trace.guards)
        return len(self.layout.table.blocks[path].events) if name == INDICATORS else Layout.of(trace.states).total

    def _advance(self, path: str, column: Any, gate: Any) -> None:
        state = self._state(path)
        if self.functions.traced[path].advance == "derivative":
            self.rates[path] = choose(gate, column, np.zeros(column.numel()))
        elif column.numel():
            self.new[path] = choose(gate, column, state)

    def _output(self, path: str, name: str, column: Any, gate: Any, torn: dict[tuple[str, str], Any]) -> None:
        full = join(path, name)
        held = self.layout.held.slices.get(full)
        if held is not None:
            column = choose(gate, column, rows(self.x, held))
            self.held[full] = column
        if (path, name) in torn:
            self.mismatch.append((column, torn[path, name]))
        else:
            self._put((path, name), column)

    def _put(self, port: tuple[str, str], column: Any) -> None:
        if port in self.taps:
            self.returned[port] = column
            column = self.taps[port](column)
        self.values[port] = column

    # --- subsystems that are enabled or triggered ---------------------------------------------------------------------

    def gate_of(self, path: str) -> Any:
        """Whether all subsystems around a block are open at this instant: True, or a number or symbol."""
        gate: Any = True
        for subsystem in self.layout.around[self.layout.table.subsystem_of[path]]:
            gate = logic_and(gate, self.is_open(subsystem))
        return gate

    def control(self, subsystem: str) -> Any:
        """Return the signal that enables or triggers a subsystem."""
        return self.part(self.layout.table.controls[subsystem])

    def is_open(self, subsystem: str) -> Any:
        """Whether a subsystem itself is open; takes note of what it remembers of its control."""
        if self.opened:
            return True
        if subsystem in self._open:
            return self._open[subsystem]
        settings = self.layout.table.subsystems[subsystem]
        last = rows(self.x, self.layout.gates.slices[subsystem])
        if (subsystem, "enable") in self._events or not self._acts(subsystem):
            gate = is_true(last)  # blocks of another rate in it go by its last tick
        elif (subsystem, "trigger") in self._events:
            i = self._events[subsystem, "trigger"]
            gate = False if self.fired is None else is_true(self.fired[i : i + 1])
        else:
            outer: Any = True
            for around in self.layout.around[subsystem.rpartition(".")[0]]:
                outer = logic_and(outer, self.is_open(around))
            now = is_true(self.control(subsystem))
            if settings.control == "enabled":
                gate, remembered = now, logic_and(outer, now)
            else:
                was = is_true(last)
                rising, falling = logic_and(now, logic_not(was)), logic_and(logic_not(now), was)
                gate = {"rising": rising, "falling": falling, "both": logic_or(rising, falling)}[settings.when]
                remembered = now
            self.gates[subsystem] = choose(outer, to_number(remembered), last)
        self._open[subsystem] = gate
        return gate

    def _state(self, path: str) -> Any:
        """Return the states of a block; those at the start where a subsystem around it has just been enabled."""
        layout = self.layout
        state = rows(self.x, layout.states.slices[path])
        if path not in layout.starts.slices or self.opened:
            return state
        outer: Any = True
        for subsystem in layout.around[layout.table.subsystem_of[path]]:
            outer = logic_and(outer, self.is_open(subsystem))
            if self._resets(subsystem):
                entering = logic_and(outer, logic_not(is_true(rows(self.x, layout.gates.slices[subsystem]))))
                state = choose(entering, rows(self.x, layout.starts.slices[path]), state)
        return state

    def _resets(self, subsystem: str) -> bool:
        """Whether states may be reset at this instant because a subsystem, not by an event, is enabled."""
        settings = self.layout.table.subsystems[subsystem]
        return settings.when == "reset" and (subsystem, "enable") not in self._events and self._acts(subsystem)

    # --- stages -------------------------------------------------------------------------------------------------------

    def replace_columns(self, change: Callable[[Any], Any]) -> None:
        """Replace every column that was made so far, as where a stage of a schedule ends."""
        for part in (self.returned, self.values):
            part.update({port: change(column) for port, column in part.items()})
        for made in (self.new, self.rates, self.held, self.gates, self._open):
            made.update({name: change(column) for name, column in made.items()})
        self.guards = [change(column) for column in self.guards]
        self.mismatch = [(change(made), change(taken)) for made, taken in self.mismatch]


def just_after(t: Any, block: Block) -> Any:
    """Return the time at which linear models evaluate a block: past its branch of the start, where it has one."""
    return t + SMALLEST if hasattr(block, "after_start") else t


def sort_names(names: Sequence[str]) -> Wanted:
    """Return the equations of an evaluator by kind; there are no guards, and no `JUMP`."""
    outputs = tuple(name for name in names if name not in (NEXT, GUARDS, INDICATORS))
    return Wanted(outputs, NEXT in names, INDICATORS in names)


def no_evaluator(path: str) -> SimulationError:
    """Return the error of a block without its evaluator."""
    return SimulationError(
        "it is evaluated from outside, and nothing was given that does so. Give what evaluates it by its path.",
        block=path,
    )


def rows(vector: Any, where: slice) -> Any:
    """Return a part of a column; an empty one stays a column, which slicing a single entry would not give."""
    if isinstance(vector, np.ndarray | Cells):
        return vector[where]
    return vector[where] if where.stop > where.start else ca.MX(0, 1)
