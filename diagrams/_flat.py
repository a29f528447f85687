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

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from ..blocks._comparison import GUARDS, NEXT
from ..blocks._errors import SampleTimeError
from ..blocks._ports import Shape
from ..blocks._symbols import size
from ._check import Checked
from ._order import Order, evaluation_order
from ._structure import Structure, Wire, join

LARGEST = float(np.finfo(float).max)


@dataclass(frozen=True)
class Layout:
    """Where things stand in a flat vector: slice and shape by dotted path."""

    slices: dict[str, slice]
    shapes: dict[str, Shape]

    @classmethod
    def of(cls, shapes: Mapping[str, Shape], offset: int = 0) -> Layout:
        """Lay out the given shapes one after the other."""
        slices = {}
        for name, shape in shapes.items():
            slices[name] = slice(offset, offset + size(shape))
            offset += size(shape)
        return cls(slices, dict(shapes))

    @property
    def total(self) -> int:
        """Number of entries, counted from the first slice."""
        bounds = [*self.slices.values()]
        return bounds[-1].stop - bounds[0].start if bounds else 0


@dataclass(frozen=True)
class Clock:
    """The ticks at which a box acts: ``offset``, ``offset + every``, …, on the common base."""

    every: int = 1
    offset: int = 0

    def acts(self, k: int) -> bool:
        """Whether it acts at tick ``k``."""
        return k >= self.offset and (k - self.offset) % self.every == 0

    def after(self, k: int) -> int:
        """Return the first of its ticks after tick ``k``."""
        return self.offset if k < self.offset else k + self.every - (k - self.offset) % self.every


@dataclass(frozen=True)
class FlatEvent:
    """An event of the flattened diagram: of a block, or of a box that is enabled or triggered in continuous time."""

    path: str
    name: str
    direction: str
    hysteresis: float
    box: bool


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
    states, held, gates, starts, loops : Layout
        Where the parts of x stand.
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
    states: Layout
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
    _parts: dict[str, tuple[Shape, ...]] = field(default_factory=dict)

    @property
    def width(self) -> int:
        """Number of entries of x."""
        return self.x0.size

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

    def ticks(self, last: int, *, every: bool) -> Iterator[int]:
        """Yield the ticks to visit, from 0 to ``last``: all, or those at which something acts, and both ends."""
        if every or not self.distinct or any(c == Clock() for c in self.distinct):
            yield from range(last + 1)
            return
        k = 0
        while k < last:
            yield k
            k = min(c.after(k) for c in self.distinct)
        yield last

    def at_tick(self, acting: frozenset[Clock]) -> Any:
        """Return the function of a tick at which the given clocks act, and the blocks of continuous frames."""
        if acting not in self._functions:
            self._functions[acting] = _tick_function(self, acting)
        return self._functions[acting]

    @cached_property
    def flow(self) -> Any:
        """The rates of the continuous states between ticks."""
        from ._between import flow

        return flow(self)

    @cached_property
    def jacobian(self) -> Any:
        """The derivative of `flow` by the continuous states, ``(t, x, w, p) -> (n, n)``."""
        from ._between import flow_jacobian

        return flow_jacobian(self)

    @cached_property
    def indicators(self) -> Any:
        """``(t, x, w, p) -> (g, open)``: indicators of `events`, and whether the boxes around them are enabled."""
        from ._between import indicators

        return indicators(self)

    @cached_property
    def jump(self) -> Any:
        """``(t, x, w, p, fired) -> x`` after events."""
        from ._between import jump

        return jump(self)

    def opening(self) -> Any:
        """Return the function ``(t, x, w, p) -> held``: what all boxes put out at the start, as if all acted."""
        from ._between import opening

        return opening(self)

    def loop_equations(self, acting: frozenset[Clock]) -> Any:
        """Return ``(t, x, w, p) -> (r, J)``: the residual of the algebraic loops at the values in x, and ∂r/∂values.

        None where no torn port acts.
        """
        key = ("loops", acting)
        if key not in self._functions:
            from ._between import loop_equations

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


def rows(vector: Any, where: slice) -> Any:
    """Return a part of a column; an empty one stays a column, which slicing a single entry would not give."""
    if isinstance(vector, np.ndarray):
        return vector[where]
    return vector[where] if where.stop > where.start else ca.MX(0, 1)


def _tick_function(flat: FlatDiagram, acting: frozenset[Clock]) -> Any:
    from ._pass import Pass

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


def flatten(
    table: Structure, checked: Checked, step: Fraction | None = None, *, name: str = "", solve: bool = False
) -> FlatDiagram:
    """Flatten a checked diagram.

    Parameters
    ----------
    step : Fraction, optional
        Seconds between two ticks; required where there is no other clock.
    name : str
        The diagram's name, for errors.
    solve : bool
        Whether algebraic loops are to be solved.

    Raises
    ------
    AlgebraicLoopError
        Ports that depend on each other within a tick, or at the start.
    SampleTimeError
        No sample time anywhere, a step that does not divide one.
    """
    base, clocks = _clocks(table, step, name)
    traced, blocks = checked.traced, table.blocks
    paths = sorted(traced)
    order = evaluation_order(table, traced, solve=solve)
    start_order = evaluation_order(table, traced, start=True, solve=solve)
    events = tuple(_events(table, checked))
    between = bool(events) or any(traced[path].advance == "derivative" for path in paths)
    between = between or any(block.transport and path not in traced for path, block in blocks.items())
    gated = {path: table.gates(table.frame_of[path]) for path in paths}

    states = Layout.of({path: (sum(size(s) for s in traced[path].states.values()),) for path in paths})
    position = states.total

    def lay(shapes: Mapping[str, Shape]) -> Layout:
        nonlocal position
        layout = Layout.of(shapes, position)
        position += layout.total
        return layout

    def is_held(path: str) -> bool:
        clock = clocks.get(table.frame_of[path])
        return bool(gated[path]) or (clock is not None and (between or clock != Clock()))

    held = lay({join(p, q): s for p in paths if is_held(p) for q, s in traced[p].outputs.items()})
    gates = lay(dict.fromkeys(sorted(table.controls), ()))
    resets = [p for p in paths if any(table.frames[g].when == "reset" for g in gated[p]) and states.shapes[p][0]]
    starts = lay({path: states.shapes[path] for path in resets})
    torn = dict.fromkeys(sorted({*order.torn, *start_order.torn}))
    loops = lay({join(*port): traced[port[0]].outputs[port[1]] for port in torn})

    stepped = sorted(path for path in blocks if path not in traced)
    plant_outputs = Layout.of({join(p, q): checked.shapes[p, q] for p in stepped for q in blocks[p].outputs})
    plant_inputs = Layout.of(
        {
            join(p, q): _input_shape(table, checked, p, q)
            for p in stepped
            for q in blocks[p].inputs
            if (p, q) in table.wires
        }
    )
    packed = {path: traced[path].pack(blocks[path], _period(table, path, base)) for path in paths}
    log_shapes = dict(plant_outputs.shapes) | {join(p, q): s for p in paths for q, s in traced[p].outputs.items()}
    parts = {
        path: [port.start_value(blocks[path], traced[path].inputs) for port in blocks[path].states.values()]
        for path in paths
    }
    start_values = [np.ravel(v) for values in parts.values() for v in values]
    ports = {join(*port): port for port in checked.shapes} | {join(*port): port for port in table.wires}
    return FlatDiagram(
        table=table,
        checked=checked,
        base=base,
        clocks=clocks,
        states=states,
        held=held,
        gates=gates,
        starts=starts,
        loops=loops,
        plant_outputs=plant_outputs,
        plant_inputs=plant_inputs,
        parameters=Layout.of({path: v.shape for path, v in packed.items()}),
        log=Layout.of(log_shapes),
        continuous=_continuous(checked, table, states),
        events=events,
        x0=np.concatenate([*start_values, np.zeros(position - states.total)]),
        p=np.concatenate([*packed.values(), np.zeros(0)]),
        order=order,
        start_order=start_order,
        ports=ports,
    )


def _input_shape(table: Structure, checked: Checked, path: str, port: str) -> Shape:
    declared = table.blocks[path].inputs[port].shape
    if declared is not None:
        return declared
    wire = table.wires[path, port]
    shape = checked.shapes[wire.block, wire.port]
    return shape if wire.index is None else np.empty(shape)[wire.index].shape


def _continuous(checked: Checked, table: Structure, states: Layout) -> np.ndarray:
    """Return the entries of x that a solver integrates."""
    found: list[int] = []
    for path, where in states.slices.items():
        trace = checked.traced[path]
        if trace.advance != "derivative":
            continue
        position = where.start
        for name, shape in trace.states.items():
            n = size(shape)
            if not table.blocks[path].states[name].discrete:
                found += range(position, position + n)
            position += n
    return np.array(found, dtype=int)


def _events(table: Structure, checked: Checked) -> Iterator[FlatEvent]:
    """Yield the events of all blocks and boxes in continuous frames, by path."""
    for path in sorted([*checked.traced, *table.controls]):
        if path in table.controls:
            if table.is_event(path):
                frame = table.frames[path]
                edge = "both" if frame.control == "enabled" else frame.when
                yield FlatEvent(path, {"enabled": "enable", "triggered": "trigger"}[frame.control], edge, 0.0, True)
            continue
        trace = checked.traced[path]
        if trace.indicators is not None:
            for name, event in table.blocks[path].events.items():
                yield FlatEvent(path, name, event.direction, getattr(event, "hysteresis", 0.0), False)


def _period(table: Structure, path: str, base: Fraction) -> float:
    frame = table.frame_of[path]
    if table.triggered(frame) is not None:
        return math.nan
    rate = table.rate(frame)
    return float(rate if rate is not None else base)


def _clocks(table: Structure, step: Fraction | None, name: str) -> tuple[Fraction, dict[str, Clock]]:
    """Return the seconds between two ticks, and the ticks of every frame that is sampled."""
    found = {path: clock for path in table.frames if (clock := table.clock(path)) is not None}
    used = {c.path: c for c in found.values()}
    base = step
    if base is None:
        if not used:
            raise SampleTimeError(
                "no subsystem has a sample time, so there is no clock. Give simulate(…, step=1e-3), or a "
                "@subsystem(sample_time=1e-3).",
                block=name or None,
            )
        times = [t for c in used.values() for t in (c.sample_time, c.offset) if t]
        base = Fraction(math.gcd(*(r.numerator * (10**9 // r.denominator) for r in times)), 10**9)
    for frame in used.values():
        for what, time in (("sample time", frame.sample_time), ("offset", frame.offset)):
            if time is not None and (time / base).denominator != 1:
                raise SampleTimeError(
                    f"its {what} {float(time):g} s is no multiple of the step {float(base):g} s; choose a step that "
                    f"divides it.",
                    block=frame.path or name or None,
                )
    return base, {
        path: Clock(int(c.sample_time / base), int(c.offset / base))
        for path, c in found.items()
        if c.sample_time is not None
    }
