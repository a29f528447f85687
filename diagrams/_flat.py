"""A diagram as one CasADi function: what happens at one tick.

    (x_next, z, log, ok) = F(t, x, w, p)

``x`` holds the states of all blocks, ``w`` the outputs of the FMUs, ``z`` their inputs, ``p`` all parameters; ``log``
is (w, all outputs, x); ``ok`` is 1 while everything is finite and every guard positive. F calls one function per block,
shared among blocks of equal structure. It is what is evaluated, differentiated and compiled.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
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
from ._order import Step, evaluation_order
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


@dataclass(frozen=True, eq=False)
class FlatDiagram:
    """A diagram flattened into one function of a tick.

    Attributes
    ----------
    function : casadi.Function
        ``(t, x, w, p) -> (x_next, z, log, ok)`` for a tick at which every sampled subsystem acts.
    base : Fraction
        Seconds between two ticks.
    states, plant_outputs, plant_inputs, parameters, log : Layout
        Where things stand in x, w, z, p and log.
    x0, p : ndarray
        Start values of the states (before any block computes its own), and parameter values.
    """

    table: Structure
    checked: Checked
    base: Fraction
    divisors: dict[str, int]
    """For every frame: after how many ticks it acts; 1 is every tick."""
    states: Layout
    held: Layout
    plant_outputs: Layout
    plant_inputs: Layout
    parameters: Layout
    log: Layout
    x0: np.ndarray
    p: np.ndarray
    order: list[Step]
    start_order: list[Step]
    ports: dict[str, tuple[str, str]]
    """Block and port behind every dotted path; an FMU's port may have dots of its own."""
    _functions: dict[frozenset[int], Any]
    _slices: dict[Any, Any]

    @property
    def function(self) -> Any:
        """The function of a tick at which every sampled subsystem acts."""
        return self.at_tick(0)

    @cached_property
    def rates(self) -> tuple[int, ...]:
        """The different numbers of ticks after which subsystems act."""
        return tuple(sorted(set(self.divisors.values())))

    def acting(self, k: int) -> frozenset[int]:
        """Return which of `rates` act in tick ``k``."""
        return frozenset(d for d in self.rates if k % d == 0)

    def at_tick(self, k: int) -> Any:
        """Return the function of tick ``k``; equal patterns of acting subsystems share one."""
        acting = self.acting(k)
        if acting not in self._functions:
            self._functions[acting] = self._build(acting)
        return self._functions[acting]

    def evaluator(self, k: int) -> Any:
        """Return `at_tick` in the form that is evaluated fastest: scalar operations where no block looks up a table.

        The results are the same to the last bit.
        """
        function = self.at_tick(k)
        if id(function) not in self._slices:
            try:
                self._slices[id(function)] = function.expand()
            except RuntimeError:
                self._slices[id(function)] = function
        return self._slices[id(function)]

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

    def _build(self, acting: frozenset[int]) -> Any:
        table, traced = self.table, self.checked.traced
        t, x, w, p = (
            ca.MX.sym(n, m)
            for n, m in (
                ("t", 1),
                ("x", self.states.total + self.held.total),
                ("w", self.plant_outputs.total),
                ("p", self.parameters.total),
            )
        )
        values: dict[tuple[str, str], Any] = {}
        for name, where in self.plant_outputs.slices.items():
            values[self.ports[name]] = _rows(w, where)
        new: dict[str, Any] = {}
        guards: list[Any] = []
        acts = {path: self.divisors[table.frame_of[path]] in acting for path in traced}
        for name, where in self.held.slices.items():
            path, port = self.ports[name]
            if not acts[path]:
                values[path, port] = _rows(x, where)
        for path, names in self.order:
            if not acts[path]:
                continue
            trace = traced[path]
            arguments = [
                self.source(path, port, values) if self.is_made(path, port, values) else np.zeros(size(shape))
                for port, shape in trace.inputs.items()  # what is not made yet is not depended on
            ]
            state, numbers = _rows(x, self.states.slices[path]), _rows(p, self.parameters.slices[path])
            made = self.block_function(path, names).call([t, state, *arguments, numbers])
            for name, column in zip(names, map(ca.densify, made), strict=True):
                if name == NEXT:
                    new[path] = column
                elif name == GUARDS:
                    guards += [column] if trace.guards else []
                else:
                    values[path, name] = column
        outputs = [values[path, name] for path in sorted(traced) for name in traced[path].outputs]
        kept = [values[self.ports[name]] for name in self.held.slices]
        old = {path: _rows(x, where) for path, where in self.states.slices.items()}
        x_next = ca.vertcat(*(new.get(path, state) for path, state in old.items()), *kept)
        z = ca.vertcat(
            *(
                ca.MX(ca.densify(ca.DM(column))) if isinstance(column, np.ndarray) else column
                for column in (self.source(*self.ports[name], values) for name in self.plant_inputs.slices)
            )
        )
        log = ca.vertcat(w, *outputs, x)
        size_of_all = sum((ca.norm_1(v) for v in (log, x_next, z) if v.numel()), ca.MX(0.0))
        ok = size_of_all <= LARGEST  # false for any NaN or infinity
        if guards:
            ok = ca.logic_and(ok, ca.mmin(ca.vertcat(*guards) > 0))
        results = [ca.densify(r) for r in (x_next, z, log, ok)]  # a buffer holds every entry, zeros too
        return ca.Function("tick", [t, x, w, p], results, ["t", "x", "w", "p"], ["x_next", "z", "log", "ok"])


def flatten(table: Structure, checked: Checked, step: Fraction | None = None) -> FlatDiagram:
    """Flatten a checked diagram.

    Parameters
    ----------
    step : Fraction, optional
        Seconds between two ticks; required where no subsystem is sampled.

    Raises
    ------
    AlgebraicLoopError
        Ports that depend on each other within a tick, or at the start.
    SampleTimeError
        No sample time anywhere, a step that does not divide one, a continuous state outside of sampled subsystems.
    """
    base, divisors = _clock(table, step)
    traced = checked.traced
    for path, trace in traced.items():
        if trace.advance == "derivative":
            raise SampleTimeError(
                "a continuous state stands outside of any sampled subsystem, and there is no solver for it yet. Put "
                "the block "
                "into a @subsystem(sample_time=…), which discretizes it.",
                block=path,
            )
    paths = sorted(traced)
    states = Layout.of({path: (sum(size(s) for s in traced[path].states.values()),) for path in paths})
    held = Layout.of(
        {
            join(path, port): shape
            for path in paths
            if divisors[table.frame_of[path]] > 1
            for port, shape in traced[path].outputs.items()
        },
        states.total,
    )
    opaque = sorted(path for path in table.blocks if path not in traced)
    plant_outputs = Layout.of({join(p, q): checked.shapes[p, q] for p in opaque for q in table.blocks[p].outputs})
    plant_inputs = Layout.of(
        {
            join(p, q): port.shape or ()
            for p in opaque
            for q, port in table.blocks[p].inputs.items()
            if (p, q) in table.wires
        }
    )
    packed = {path: traced[path].pack(table.blocks[path], _period(table, path, base)) for path in paths}
    parameters = Layout.of({path: v.shape for path, v in packed.items()})
    log_shapes = dict(plant_outputs.shapes) | {join(p, q): s for p in paths for q, s in traced[p].outputs.items()}
    x0 = np.concatenate(
        [
            *(
                np.ravel(port.start_value(table.blocks[path], traced[path].inputs))
                for path in paths
                for port in table.blocks[path].states.values()
            ),
            np.zeros(held.total),
        ]
    )
    return FlatDiagram(
        table=table,
        checked=checked,
        base=base,
        divisors=divisors,
        states=states,
        held=held,
        plant_outputs=plant_outputs,
        plant_inputs=plant_inputs,
        parameters=parameters,
        log=Layout.of(log_shapes),
        x0=x0,
        p=np.concatenate([*packed.values(), np.zeros(0)]),
        order=evaluation_order(table, traced),
        start_order=evaluation_order(table, traced, start=True),
        ports={join(*port): port for port in checked.shapes} | {join(*port): port for port in table.wires},
        _functions={},
        _slices={},
    )


def _rows(vector: Any, where: slice) -> Any:
    """Return a part of a column; an empty one stays a column, which slicing a single entry would not give."""
    return vector[where] if where.stop > where.start else ca.MX(0, 1)


def _period(table: Structure, path: str, base: Fraction) -> float:
    rate = table.rate(table.frame_of[path])
    return float(rate if rate is not None else base)


def _clock(table: Structure, step: Fraction | None) -> tuple[Fraction, dict[str, int]]:
    rates = {path: rate for path in table.frames if (rate := table.rate(path)) is not None}
    used: Iterable[Fraction] = list(rates.values())
    if not rates and step is None:
        raise SampleTimeError(
            "no subsystem has a sample time, so there is no clock. Give simulate(…, step=1e-3), or a "
            "@subsystem(sample_time=1e-3)."
        )
    base = step
    if base is None:
        base = Fraction(math.gcd(*(r.numerator * (10**9 // r.denominator) for r in used)), 10**9)
    for path, rate in rates.items():
        if (rate / base).denominator != 1:
            raise SampleTimeError(
                f"its sample time {float(rate):g} s is no multiple of the step {float(base):g} s; choose a step that "
                f"divides it.",
                block=path,
            )
    return base, {path: int(rates[path] / base) if path in rates else 1 for path in table.frames}
