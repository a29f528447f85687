"""One pass over all blocks in the order of evaluation, with symbols or with numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.tracing.numpy_check import GUARDS, NEXT
from ...blocks.tracing.symbols import size
from ..wiring.structure import join
from .flat_diagram import FlatDiagram
from .layout import Clock, rows

TRUE = 0.5
"""A logic signal is true above this."""


class Pass:
    """What all blocks make of one instant.

    Parameters
    ----------
    flat : FlatDiagram
        The diagram.
    acting : frozenset of Clock
        The clocks that tick; without any it is an instant between ticks.
    t, x, w, p : columns
        Symbols, or numbers.
    fired : column, optional
        Which of the diagram's events fire; without it none does.
    opened : bool
        Evaluate every box as if it acted.
    order : list of Step, optional
        Another order than that of a tick.
    before, visit : callable, optional
        ``before(path, inputs)`` is called ahead of each block, ``visit(path, names, inputs, made)`` after it.
    taps : mapping, optional
        By port: what its consumers get instead of what is put out there, a function of that.
    """

    def __init__(
        self,
        flat: FlatDiagram,
        acting: frozenset[Clock],
        t: Any,
        x: Any,
        w: Any,
        p: Any,
        *,
        fired: Any = None,
        opened: bool = False,
        order: Any = None,
        before: Callable[..., None] | None = None,
        visit: Callable[..., None] | None = None,
        taps: Mapping[tuple[str, str], Callable[[Any], Any]] | None = None,
    ):
        self.flat, self.acting, self.opened = flat, acting, opened
        self.t, self.x, self.w, self.p, self.fired = t, x, w, p, fired
        self.order = flat.order.steps if order is None else order
        self.before, self.visit, self.taps = before, visit, taps or {}
        self.returned: dict[tuple[str, str], Any] = {}
        """What the blocks put out at ports that are tapped."""
        self.values: dict[tuple[str, str], Any] = {}
        self.new: dict[str, Any] = {}
        """Next states of the blocks that act, by path."""
        self.rates: dict[str, Any] = {}
        """Time derivatives of the states of continuous blocks, by path."""
        self.held: dict[str, Any] = {}
        self.gates: dict[str, Any] = {}
        """What enabled and triggered boxes remember, by path."""
        self.guards: list[Any] = []
        self.mismatch: list[tuple[Any, Any]] = []
        """For each torn port: what came round, and what was taken."""
        self._gate: dict[str, Any] = {}
        self._events = {(e.path, e.name): i for i, e in enumerate(flat.events)}

    def run(self) -> Pass:
        """Evaluate all blocks."""
        flat, table, traced = self.flat, self.flat.table, self.flat.checked.traced
        for name, where in flat.plant_outputs.slices.items():
            self._put(flat.ports[name], rows(self.w, where))
        acts = {path: self._acts(table.frame_of[path]) for path in traced}
        for name, where in flat.held.slices.items():
            path, port = flat.ports[name]
            if not acts[path]:
                self._put((path, port), rows(self.x, where))
        torn = {}
        for name, where in flat.loops.slices.items():
            path, port = flat.ports[name]
            if acts[path]:
                torn[path, port] = rows(self.x, where)
                self._put((path, port), torn[path, port])
        for path, names in self.order:
            if not acts[path]:
                continue
            trace = traced[path]
            inputs = {
                q: flat.source(path, q, self.values) if flat.is_made(path, q, self.values) else None
                for q in trace.inputs
            }
            if self.before is not None:
                self.before(path, inputs)
            made = self._evaluate(path, names, inputs)
            if self.visit is not None:
                self.visit(path, names, inputs, dict(zip(names, made, strict=True)))
            gate = self.gate_of(path)
            for name, column in zip(names, made, strict=True):
                if name == NEXT:
                    self._advance(path, column, gate)
                elif name == GUARDS:
                    self.guards += [choose(gate, column, np.ones(len(trace.guards)))] if trace.guards else []
                else:
                    self._output(path, name, column, gate, torn)
        for box in self.flat.gates.slices:
            if self._acts(box):
                self.is_open(box)  # one without blocks of its own remembers, too
        for path in flat.starts.slices:  # what has another rate than the box that resets it
            if not acts[path] and any(self._resets(box) for box in table.gates(table.frame_of[path])):
                self.new[path] = self._state(path)
        return self

    def _acts(self, frame: str) -> bool:
        clock = self.flat.clocks.get(frame)
        return clock is None or self.opened or clock in self.acting

    def arguments(self, path: str, inputs: dict[str, Any] | None = None) -> list[Any]:
        """Return t, x, the inputs and p of a block, as its functions take them."""
        flat, shapes = self.flat, self.flat.checked.traced[path].inputs
        if inputs is None:
            inputs = {q: flat.source(path, q, self.values) for q in shapes}
        columns = [np.zeros(size(s)) if inputs[q] is None else inputs[q] for q, s in shapes.items()]
        return [self.t, self._state(path), *columns, rows(self.p, flat.parameters.slices[path])]

    def _evaluate(self, path: str, names: tuple[str, ...], inputs: dict[str, Any]) -> list[Any]:
        # what is not made yet is not depended on
        made = self.flat.block_function(path, names).call(self.arguments(path, inputs))
        return [ca.densify(m) for m in made]

    def _advance(self, path: str, column: Any, gate: Any) -> None:
        state = self._state(path)
        if self.flat.checked.traced[path].advance == "derivative":
            self.rates[path] = choose(gate, column, np.zeros(column.numel()))
        elif column.numel():
            self.new[path] = choose(gate, column, state)

    def _output(self, path: str, name: str, column: Any, gate: Any, torn: dict[tuple[str, str], Any]) -> None:
        full = join(path, name)
        held = self.flat.held.slices.get(full)
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

    def residual(self) -> Any:
        """Return the largest mismatch of the torn ports, relative to 1 + their size."""
        if not self.mismatch:
            return ca.MX(0.0)
        made, taken = (ca.vertcat(*columns) for columns in zip(*self.mismatch, strict=True))
        return ca.norm_inf(made - taken) / (1 + ca.norm_inf(taken))

    # --- boxes that are enabled or triggered ------------------------------------------------------------------------

    def gate_of(self, path: str) -> Any:
        """Whether all boxes around a block are open at this instant: True, or a number or symbol."""
        gate: Any = True
        for box in self.flat.table.gates(self.flat.table.frame_of[path]):
            gate = both(gate, self.is_open(box))
        return gate

    def control(self, box: str) -> Any:
        """Return the signal that enables or triggers a box."""
        wire = self.flat.table.controls[box]
        return self.flat.part(self.values[wire.block, wire.port], wire)

    def is_open(self, box: str) -> Any:
        """Whether a box itself is open, and what it remembers of it."""
        if self.opened:
            return True
        if box in self._gate:
            return self._gate[box]
        table, frame = self.flat.table, self.flat.table.frames[box]
        last = rows(self.x, self.flat.gates.slices[box])
        if (box, "enable") in self._events or not self._acts(box):
            gate = above(last)  # blocks of another rate in it go by its last tick
        elif (box, "trigger") in self._events:
            i = self._events[box, "trigger"]
            gate = False if self.fired is None else above(self.fired[i : i + 1])
        else:
            outer: Any = True
            for around in table.gates(box.rpartition(".")[0]):
                outer = both(outer, self.is_open(around))
            now = above(self.control(box))
            if frame.control == "enabled":
                gate, remembered = now, both(outer, now)
            else:
                rising, falling = both(now, negated(above(last))), both(negated(now), above(last))
                gate = {"rising": rising, "falling": falling, "both": either(rising, falling)}[frame.when]
                remembered = now
            self.gates[box] = choose(outer, number(remembered), last)
        self._gate[box] = gate
        return gate

    def _state(self, path: str) -> Any:
        """Return the states of a block; those at the start where a box around it has just been enabled."""
        flat = self.flat
        state = rows(self.x, flat.states.slices[path])
        if path not in flat.starts.slices or self.opened:
            return state
        outer: Any = True
        for box in flat.table.gates(flat.table.frame_of[path]):
            outer = both(outer, self.is_open(box))
            if self._resets(box):
                entering = both(outer, negated(above(rows(self.x, flat.gates.slices[box]))))
                state = choose(entering, rows(self.x, flat.starts.slices[path]), state)
        return state

    def _resets(self, box: str) -> bool:
        """Whether states may start anew at this instant because a box, not by an event, is enabled."""
        return self.flat.table.frames[box].when == "reset" and (box, "enable") not in self._events and self._acts(box)


def above(value: Any) -> Any:
    """Whether a logic signal (a column of one entry) is true."""
    if isinstance(value, ca.MX):
        return value > TRUE
    return bool(float(np.ravel(np.array(value))[0]) > TRUE)


def both(a: Any, b: Any) -> Any:
    """Logic and, of truth values or symbols."""
    if isinstance(a, bool):
        return b if a else False
    if isinstance(b, bool):
        return a if b else False
    return ca.logic_and(a, b)


def either(a: Any, b: Any) -> Any:
    """Logic or, of truth values or symbols."""
    return a or b if isinstance(a, bool) and isinstance(b, bool) else ca.logic_or(a, b)


def negated(a: Any) -> Any:
    """Logic not, of a truth value or a symbol."""
    return not a if isinstance(a, bool) else ca.logic_not(a)


def number(a: Any) -> Any:
    """Return 1.0 or 0.0 for a truth value; a symbol stays."""
    return np.array([float(a)]) if isinstance(a, bool) else a


def choose(condition: Any, a: Any, b: Any) -> Any:
    """Return ``a`` where the condition holds, else ``b``; NaN in the other one does no harm."""
    if isinstance(condition, bool):
        return a if condition else b
    return ca.if_else(condition, a, b)
