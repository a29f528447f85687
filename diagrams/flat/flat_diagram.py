"""A diagram as CasADi functions: what happens at one tick, and between two.

    (x_next, z, log, ok) = F(t, x, w, p)    at a tick, for every pattern of boxes that act in it
    dx = f(t, x, w, p)                      between ticks: the rates of the continuous states
    g = h(t, x, w, p)                       between ticks: the indicators of all events
    x_next = J(t, x, w, p, fired)           at an event

``x`` holds the states of all blocks, then what boxes keep: the outputs that are held, what gates remember, the last
solution of algebraic loops. ``w`` holds the outputs of the FMUs and of transport delays, ``z`` what they are driven by,
``p`` all parameters; ``log`` is (w, all outputs, x, residual of the algebraic loops); ``ok`` is 1 while everything is
finite and every guard positive. All of them are made of the same pass over the blocks, which calls one function per
block, shared among blocks of equal structure. They are what is evaluated, differentiated and compiled.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ...blocks.core.layout import Layout
from ...blocks.tracing.numpy_check import GUARDS, NEXT
from ...blocks.tracing.symbols import size
from ..wiring.check import Checked
from ..wiring.evaluation_order import Order
from ..wiring.structure import Structure, Wire
from .layout import Clock, FlatEvent, StateLayout, rows

LARGEST = float(np.finfo(float).max)


@dataclass(frozen=True, eq=False)
class FlatDiagram:
    """A diagram flattened into functions of an instant.

    Attributes
    ----------
    function : casadi.Function
        ``(t, x, w, p) -> (x_next, z, log, ok)`` for a tick at which every sampled subsystem acts.
    flow : casadi.Function
        ``(t, x, w, p) -> dx``, the rates of the entries `continuous` of x.
    base : Fraction
        Seconds between two ticks.
    clocks : dict
        For every frame that is sampled: at which ticks it acts.
    states : StateLayout
        Where the states of the blocks stand in x: by block, and by state.
    held, gates, starts, loops : Layout
        Where the other parts of x stand.
    plant_outputs, plant_inputs, parameters, log : Layout
        Where things stand in w, z, p and log.
    continuous : ndarray of int
        The entries of x that are integrated.
    x0, p : ndarray
        Start values of x (before any block computes its own), and parameter values.
    """

    table: Structure
    checked: Checked
    base: Fraction
    clocks: dict[str, Clock]
    states: StateLayout
    held: Layout
    gates: Layout
    starts: Layout
    loops: Layout
    plant_outputs: Layout
    plant_inputs: Layout
    parameters: Layout
    log: Layout
    continuous: np.ndarray
    events: tuple[FlatEvent, ...]
    x0: np.ndarray
    p: np.ndarray
    order: Order
    start_order: Order
    ports: dict[str, tuple[str, str]]
    """Block and port behind every dotted path; an FMU's port may have dots of its own."""
    _functions: dict[Any, Any] = field(default_factory=dict)
    _slices: dict[Any, Any] = field(default_factory=dict)

    @property
    def width(self) -> int:
        """Number of entries of x."""
        return self.x0.size

    @cached_property
    def labels(self) -> list[str]:
        """Names of all entries of x: ``path.state`` of states, ``held(path.port)``, ``gate(path)`` and so on."""
        others = ((self.held, "held"), (self.gates, "gate"), (self.starts, "start"), (self.loops, "loop"))
        return self.states.labels + [f"{kind}({label})" for layout, kind in others for label in layout.labels]

    @property
    def continuous_labels(self) -> list[str]:
        """Names of the entries of x that are integrated."""
        return [self.labels[i] for i in self.continuous]

    @property
    def function(self) -> Any:
        """The function of a tick at which every sampled subsystem acts."""
        return self.at_tick(frozenset(self.clocks.values()))

    @cached_property
    def distinct(self) -> tuple[Clock, ...]:
        """The different clocks."""
        return tuple(sorted(set(self.clocks.values()), key=lambda c: (c.every, c.offset)))

    @cached_property
    def hybrid(self) -> bool:
        """Whether something happens between ticks: continuous states, events, or a transport delay."""
        delayed = any(self.table.blocks[self.ports[name][0]].transport for name in self.plant_inputs.slices)
        return bool(self.continuous.size or self.events or delayed)

    def acting(self, k: int) -> frozenset[Clock]:
        """Return the clocks that tick at tick ``k``."""
        return frozenset(c for c in self.distinct if c.acts(k))

    def taken_at(self, acting: frozenset[Clock]) -> np.ndarray:
        """Return the entries of x that a tick renews at which the given clocks act: what sampled boxes keep."""
        key = ("taken", acting)
        if key in self._slices:
            return self._slices[key]  # type: ignore[no-any-return]
        owners = [(where, name) for part in (self.states, self.starts) for name, where in part.slices.items()]
        owners += [(where, self.ports[name][0]) for name, where in self.held.slices.items()]
        frames = [(where, self.table.frame_of[path]) for where, path in owners]
        frames += [(where, box) for box, where in self.gates.slices.items()]
        found = [np.arange(w.start, w.stop) for w, frame in frames if self.clocks.get(frame) in acting]
        self._slices[key] = np.concatenate([*found, np.zeros(0, dtype=int)])
        return self._slices[key]  # type: ignore[no-any-return]

    def ticks(self, k: int, last: int, *, every: bool) -> Iterator[int]:
        """Yield the ticks to visit after tick ``k``: all, or those at which something acts, and the last one."""
        if every or not self.distinct or Clock() in self.distinct:
            yield from range(k + 1, last + 1)
            return
        while (k := min(c.after(k) for c in self.distinct)) < last:
            yield k
        yield last

    def at_tick(self, acting: frozenset[Clock]) -> Any:
        """Return the function of a tick at which the given clocks act, and the blocks of continuous frames."""
        if acting not in self._functions:
            self._functions[acting] = _tick_function(self, acting)
        return self._functions[acting]

    @cached_property
    def flow(self) -> Any:
        """The rates of the continuous states between ticks."""
        from .functions import flow

        return flow(self)

    @cached_property
    def jacobian(self) -> Any:
        """The derivative of `flow` by the continuous states, ``(t, x, w, p) -> (n, n)``."""
        from .functions import flow_jacobian

        return flow_jacobian(self)

    @cached_property
    def indicators(self) -> Any:
        """``(t, x, w, p) -> (g, open)``: indicators of `events`, and whether the boxes around them are enabled."""
        from .functions import indicators

        return indicators(self)

    @cached_property
    def jump(self) -> Any:
        """``(t, x, w, p, fired) -> x`` after events."""
        from .functions import jump

        return jump(self)

    def loop_equations(self, acting: frozenset[Clock]) -> Any:
        """Return ``(t, x, w, p) -> (r, J)``: the residual of the algebraic loops at the values in x, and ∂r/∂values.

        None where no torn port acts.
        """
        key = ("loops", acting)
        if key not in self._functions:
            from .functions import loop_equations

            self._functions[key] = loop_equations(self, acting)
        return self._functions[key]

    def fast(self, function: Any) -> Any:
        """Return a function in the form that is evaluated fastest: scalar operations where no block looks up a table.

        The results are the same to the last bit.
        """
        if id(function) not in self._slices:
            try:
                self._slices[id(function)] = (function.expand(), function)  # the key lives as long as its function
            except RuntimeError:
                self._slices[id(function)] = (function, function)
        return self._slices[id(function)][0]

    def is_made(self, path: str, port: str, values: Mapping[tuple[str, str], Any]) -> bool:
        """Whether the signal at an input is among ``values``, or a default."""
        wire = self.table.wires.get((path, port))
        return wire is None or (wire.block, wire.port) in values

    def source(self, path: str, port: str, values: Mapping[tuple[str, str], Any]) -> Any:
        """Return the flat column at an input of a block, from the columns of all outputs."""
        wire = self.table.wires.get((path, port))
        if wire is None:
            default = self.table.blocks[path].inputs[port].default
            return np.ravel(np.asarray(default))
        column = values[wire.block, wire.port]
        return column if wire.index is None else self.part(column, wire)

    def part(self, column: Any, wire: Wire) -> Any:
        """Return the part of an output's flat column that a wire takes."""
        if wire.index is None:
            return column
        shape = self.checked.shapes[wire.block, wire.port]
        index = np.ravel(np.arange(size(shape)).reshape(shape)[wire.index])
        return column[index.tolist()] if not isinstance(column, np.ndarray) else column[index]

    def block_function(self, path: str, names: tuple[str, ...]) -> Any:
        """Return the function of a block that evaluates only ``names``, shared among equal blocks."""
        trace = self.checked.traced[path]
        every = (*trace.outputs, NEXT, GUARDS)
        if names == every:
            return trace.function
        key = (id(trace), names)
        if key not in self._slices:
            f = trace.function
            self._slices[key] = f.slice("block", list(range(f.n_in())), [every.index(n) for n in names])
        return self._slices[key]

    def symbols(self) -> tuple[Any, Any, Any, Any]:
        """Return fresh symbols t, x, w, p."""
        return (
            ca.MX.sym("t"),
            ca.MX.sym("x", self.width),
            ca.MX.sym("w", self.plant_outputs.total),
            ca.MX.sym("p", self.parameters.total),
        )

    def next_columns(self, x: Any, done: Any) -> Any:
        """Return x with the parts that a pass over the blocks has made anew.

        Parameters
        ----------
        x : column
            The vector x before.
        done : Pass
            With the new states, held outputs and gates by name.
        """
        parts = []
        made: list[tuple[Layout, Mapping[str, Any]]] = [
            (self.states, done.new),
            (self.held, done.held),
            (self.gates, done.gates),
            (self.starts, {}),
            (self.loops, {}),
        ]
        for layout, new in made:
            parts += [new.get(name, rows(x, where)) for name, where in layout.slices.items()]
        return ca.vertcat(*parts) if parts else ca.MX(0, 1)


def _tick_function(flat: FlatDiagram, acting: frozenset[Clock]) -> Any:
    from .evaluate import Pass

    t, x, w, p = flat.symbols()
    done = Pass(flat, acting, t, x, w, p).run()
    outputs = [done.values[flat.ports[name]] for name in list(flat.log.slices)[len(flat.plant_outputs.slices) :]]
    x_next = flat.next_columns(x, done)
    z = ca.vertcat(
        *(
            ca.MX(ca.densify(ca.DM(column))) if isinstance(column, np.ndarray) else column
            for column in (flat.source(*flat.ports[name], done.values) for name in flat.plant_inputs.slices)
        )
    )
    residual = [done.residual()] if flat.loops.slices else []
    log = ca.vertcat(w, *outputs, x, *residual)
    size_of_all = sum((ca.norm_1(v) for v in (log, x_next, z) if v.numel()), ca.MX(0.0))
    ok = size_of_all <= LARGEST  # false for any NaN or infinity
    if done.guards:
        ok = ca.logic_and(ok, ca.mmin(ca.vertcat(*done.guards) > 0))
    results = [ca.densify(r) for r in (x_next, z, log, ok)]  # a buffer holds every entry, zeros too
    return ca.Function("tick", [t, x, w, p], results, ["t", "x", "w", "p"], ["x_next", "z", "log", "ok"])
