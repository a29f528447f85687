"""Derivatives of a diagram's functions at an instant, with signals injected and wires cut."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from ...blocks.core import Layout, NonFiniteError, UnknownNameError, elements, near
from ...blocks.tracing import Traced, size
from ..flat import (
    Apart,
    Derivative,
    Evaluators,
    FlatDiagram,
    Instant,
    Schedule,
    TickPattern,
    evaluate,
    loop_mismatch,
    next_x,
    plant_inputs,
    rates,
    trace_schedule,
)
from ..results import resolve
from ..simulation import Workspace
from ..wiring import Wire, join
from .findings import Finding, StepsOnly

_RESULTS, _ARGUMENTS = ("x", "z", "y", "dx", "r"), ("x", "w", "d")


@dataclass(frozen=True)
class Signal:
    """A place in a diagram: an output port, or entries of it."""

    name: str
    port: tuple[str, str]
    entries: tuple[int, ...]
    labels: tuple[str, ...]


def find_signal(flat: FlatDiagram, name: str) -> Signal:
    """Return the place that a wire's or port's name stands for.

    Raises
    ------
    UnknownNameError
        If there is none, or several.
    """
    wires, ports = flat.table.names, flat.log.slices
    if not isinstance(name, str):
        raise UnknownNameError(f"found {name!r}; expected the name of a wire, or the path of a port.")
    name, entry = _split(name, {*wires, *ports})
    try:
        full = resolve(name, wires, ports)
    except UnknownNameError as error:
        if error.candidates:
            raise
        known = {n.rpartition(".")[2] for n in (*wires, *ports)} | {*wires, *ports}
        raise UnknownNameError(f"there is no signal {name!r} in this diagram. {near(name, known)}") from None
    wire = wires[full] if full in wires else Wire(*flat.ports[full])
    shape = flat.checked.shapes[wire.block, wire.port]
    index = np.arange(size(shape)).reshape(shape)
    part = index if wire.index is None else np.asarray(index[wire.index])
    labels = np.array(elements(name if name in wires else full, part.shape)).reshape(part.shape)
    if entry:
        if len(entry) != part.ndim or any(not i < n for i, n in zip(entry, part.shape, strict=False)):
            raise UnknownNameError(
                f"{full!r} has the shape {part.shape}, and no entry {list(entry)}; entries are counted from 0."
            )
        part, labels = part[entry], labels[entry]
    flat_labels = tuple(str(e) for e in np.ravel(labels))
    return Signal(name, (wire.block, wire.port), tuple(np.ravel(part).tolist()), flat_labels)


def _split(name: str, known: set[str]) -> tuple[str, tuple[int, ...]]:
    """Return the name of a signal, and the entry behind it: ``q[1]`` is entry 1 of ``q``."""
    found = re.fullmatch(r"(.+)\[(\d+(?:,\d+)*)\]", name)
    if found is None or name in known:
        return name, ()
    return found[1], tuple(int(i) for i in found[2].split(","))


class Parts:
    """Exact derivatives of what a diagram does at a tick and between ticks.

    Parameters
    ----------
    flat : FlatDiagram
        The diagram.
    inputs : sequence of Signal
        Where signals d are injected: added to what the consumers of the port get.
    outputs : sequence of Signal
        What is measured: what the block puts out, ahead of the injection.
    openings : sequence of Signal
        Where the wire is cut: consumers get what the port puts out in the closed diagram, as a given value, and what is
        injected. So the motion stays that of the closed diagram, whatever is cut.
    """

    def __init__(
        self,
        flat: FlatDiagram,
        inputs: Sequence[Signal],
        outputs: Sequence[Signal],
        openings: Sequence[Signal],
        evaluators: Evaluators | None = None,
    ):
        self.flat, self.inputs, self.outputs, self.openings = flat, inputs, outputs, openings
        lengths = Layout.of({str(i): (len(s.entries),) for i, s in enumerate(inputs)})
        self.n_inputs, self.injected = lengths.total, [*lengths.slices.values()]
        self.cut: dict[tuple[str, str], set[int]] = {}
        for s in openings:
            self.cut.setdefault(s.port, set()).update(s.entries)
        self.evaluators = evaluators
        self._schedules: dict[frozenset[TickPattern], Schedule] = {}
        self._derivatives: dict[frozenset[TickPattern], Derivative] = {}
        self._workspace = Workspace(flat, evaluators) if flat.loops.slices else None

    @cached_property
    def varies(self) -> bool:
        """Whether the flow between ticks depends on time."""
        return bool(self.flat.flow.depends("dx", "t").any()) or self._workspace is not None

    def _taps(self, d: Any, c: Any) -> dict[tuple[str, str], Any]:
        injected: dict[tuple[str, str], list[tuple[int, int]]] = {}
        for signal, where in zip(self.inputs, self.injected, strict=True):
            places = range(where.start, where.stop)
            injected.setdefault(signal.port, []).extend(zip(signal.entries, places, strict=True))
        cut = Layout.of({join(*port): self.flat.checked.shapes[port] for port in self.cut})
        kept = {port: c[cut.slices[join(*port)]] for port in self.cut}

        def tap(port: tuple[str, str]) -> Any:
            def change(column: Any) -> Any:
                column = column if isinstance(column, ca.MX) else ca.MX(ca.DM(column))
                parts = [kept[port][i] if i in self.cut.get(port, ()) else column[i] for i in range(column.numel())]
                for entry, k in injected.get(port, ()):
                    parts[entry] = parts[entry] + d[k]
                return ca.vertcat(*parts)

            return change

        return {port: tap(port) for port in {*injected, *self.cut}}

    def _measured(self, done: Instant) -> Any:
        columns = []
        for signal in self.outputs:
            column = done.returned.get(signal.port)
            if column is None:
                column = done.values[signal.port]
            columns.append(
                ca.MX(ca.DM(column[list(signal.entries)]))
                if isinstance(column, np.ndarray)
                else column[list(signal.entries)]
            )
        return ca.vertcat(*columns) if columns else ca.MX(0, 1)

    def _closed(self, acting: frozenset[TickPattern]) -> Schedule:
        """Return ``(t, x, w, p) -> c``: what the ports that are cut put out in the closed diagram."""
        if acting not in self._schedules:
            flat, symbols = self.flat, self.flat.symbols()

            def results(apart: Apart) -> Mapping[str, Any]:
                instant = evaluate(flat, flat.blocks, acting, **symbols, apart=apart)
                return {"c": ca.vertcat(*(ca.densify(ca.MX(instant.values[port])) for port in self.cut))}

            self._schedules[acting] = trace_schedule("closed", symbols, results)
        return self._schedules[acting]

    def _derivative(self, acting: frozenset[TickPattern]) -> Derivative:
        """Return values and derivatives by (x, w, d) at an instant; ``NONE`` is one between ticks."""
        if acting not in self._derivatives:
            flat, symbols = self.flat, self.flat.symbols()
            d = ca.MX.sym("d", self.n_inputs)
            c = ca.MX.sym("c", sum(size(flat.checked.shapes[port]) for port in self.cut))

            def results(apart: Apart) -> Mapping[str, Any]:
                instant = evaluate(flat, flat.blocks, acting, **symbols, taps=self._taps(d, c), apart=apart)
                found = {"x_next": next_x(instant), "z": plant_inputs(instant), "y": self._measured(instant)}
                return {**found, "dx": rates(instant), "r": loop_mismatch(instant)}

            schedule = trace_schedule("parts", {**symbols, "d": d, "c": c}, results)
            self._derivatives[acting] = Derivative(schedule, [(name, None) for name in _ARGUMENTS])
        return self._derivatives[acting]

    def _solved(self, acting: frozenset[TickPattern], t: float, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return x with the algebraic loops solved at an instant."""
        return x if self._workspace is None else self._workspace.solve_loops(acting, t, x, w)

    def at(self, acting: frozenset[TickPattern], t: float, x: np.ndarray, w: np.ndarray) -> dict[Any, Any]:
        """Return the values x⁺, z, y, dx and, by name and argument, their derivatives at an instant.

        ``found["z"]`` is a value, ``found["z", "w"]`` the derivative of z by w. Algebraic loops are solved, and
        eliminated by the implicit function theorem.
        """
        flat = self.flat
        x = self._solved(acting, t, x, w)
        at = t, x, w, flat.p
        c = self._closed(acting)(*at, evaluators=self.evaluators)[0] if self.cut else np.zeros(0)
        numbers = self._derivative(acting)(*at, np.zeros(self.n_inputs), c, evaluators=self.evaluators)
        names, arguments = _RESULTS, _ARGUMENTS
        keys = [(n, a) for n in names for a in arguments]
        found: dict[Any, Any] = dict(zip([*names, *keys], numbers, strict=True))
        self._check_finite(found, keys, t)
        if found["r"].size:
            where = flat.active_loops(acting)
            through_all = np.linalg.solve(
                found["r", "x"][:, where].T, np.vstack([found[n, "x"][:, where] for n in names[:4]]).T
            ).T
            for n, rows in Layout.of({n: (len(found[n]),) for n in names[:4]}).slices.items():
                for a in arguments:
                    found[n, a] = found[n, a] - through_all[rows] @ found["r", a]
                found[n, "x"][:, where] = 0.0
        return found

    def _check_finite(self, found: Any, keys: Any, t: float) -> None:
        """Refuse a point at which something has no derivative, such as a square root at zero."""
        for key in keys:
            if not np.all(np.isfinite(found[key])):
                raise NonFiniteError(
                    "the derivative of what the diagram does is not finite here. Linearize at another "
                    "instant, or take a block that is smooth there.",
                    t=t,
                )


def steps_only(flat: FlatDiagram) -> tuple[Finding, ...]:
    """Return what the linear model does not follow: outputs that depend on an input only by steps.

    A quantizer, an encoder, a comparison: their derivative is zero everywhere, and it is known as such.
    """
    return tuple(
        StepsOnly(path, port, source)
        for path, trace in flat.checked.traced.items()
        for port, source in _steps_of(trace)
    )


_STEPS: WeakKeyDictionary[Traced, list[tuple[str, str]]] = WeakKeyDictionary()  # traces are shared, and looked at once


def _steps_of(trace: Traced) -> list[tuple[str, str]]:
    if trace not in _STEPS:
        _STEPS[trace] = _steps(trace)
    return _STEPS[trace]


def _steps(trace: Traced) -> list[tuple[str, str]]:
    try:
        f = trace.function.expand()
    except RuntimeError:  # a table, or an opaque block
        return []
    arguments = [ca.SX.sym(f"a{i}", f.sparsity_in(i)) for i in range(f.n_in())]
    results, found = f.call(arguments), []
    for port, y in zip(trace.outputs, results, strict=False):
        for source, u in zip(trace.inputs, arguments[2:], strict=False):
            if u.numel() and y.numel() and ca.depends_on(y, u):
                slopes: list[Any] = ca.jacobian(y, u).nonzeros()
                if all(e.is_zero() for e in slopes):
                    found.append((port, source))
    return found
