"""Derivatives of a diagram's functions at an instant, with signals injected and wires cut."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ..blocks._errors import UnknownNameError, near
from ..blocks._symbols import size
from ._between import NONE
from ._flat import Clock, FlatDiagram
from ._operating_point import elements
from ._pass import Pass
from ._run import resolve
from ._structure import Wire


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
    try:
        full = resolve(name, wires, ports)
    except UnknownNameError as error:
        short = {n.rpartition(".")[2] for n in (*wires, *ports)}
        text = str(error)
        if "stands for several" in text:
            raise
        raise UnknownNameError(f"there is no signal {name!r} in this diagram. {near(name, short)}") from None
    wire = wires[full] if full in wires else Wire(*flat.ports[full])
    shape = flat.checked.shapes[wire.block, wire.port]
    index = np.arange(size(shape)).reshape(shape)
    part = index if wire.index is None else index[wire.index]
    label = name if name in wires else full
    return Signal(name, (wire.block, wire.port), tuple(np.ravel(part).tolist()), tuple(elements(label, part.shape)))


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
        Where the wire is cut: consumers get the value of the operating point, and what is injected.
    values : mapping
        Values of all ports at the operating point, which cut wires keep.
    """

    def __init__(
        self,
        flat: FlatDiagram,
        inputs: Sequence[Signal],
        outputs: Sequence[Signal],
        openings: Sequence[Signal],
        values: Any,
    ):
        self.flat, self.inputs, self.outputs, self.openings, self.values = flat, inputs, outputs, openings, values
        self.n_inputs = sum(len(s.entries) for s in inputs)
        self._functions: dict[Any, Any] = {}

    def _taps(self, d: Any) -> dict[tuple[str, str], Any]:
        injected: dict[tuple[str, str], list[tuple[int, int]]] = {}
        position = 0
        for signal in self.inputs:
            injected.setdefault(signal.port, [])
            for entry in signal.entries:
                injected[signal.port].append((entry, position))
                position += 1
        cut = {s.port: set[int]() for s in self.openings}
        for s in self.openings:
            cut[s.port] |= set(s.entries)

        def tap(port: tuple[str, str]) -> Any:
            kept = np.ravel(np.asarray(self.values[".".join(port)], dtype=float))

            def change(column: Any) -> Any:
                n = kept.size
                parts = [ca.MX(float(kept[i])) if i in cut.get(port, ()) else column[i] for i in range(n)]
                for entry, k in injected.get(port, ()):
                    parts[entry] = parts[entry] + d[k]
                return ca.vertcat(*parts)

            return change

        return {port: tap(port) for port in {*injected, *cut}}

    def _measured(self, done: Pass) -> Any:
        columns = []
        for signal in self.outputs:
            column = done.returned.get(signal.port)
            if column is None:
                column = done.values[signal.port]
            columns.append(column[list(signal.entries)])
        return ca.vertcat(*columns) if columns else ca.MX(0, 1)

    def _function(self, acting: frozenset[Clock] | None) -> Any:
        """Return values and Jacobians by (x, w, d): of a tick, or for None of the flow between ticks."""
        if acting in self._functions:
            return self._functions[acting]
        flat = self.flat
        t, x, w, p = flat.symbols()
        d = ca.MX.sym("d", self.n_inputs)
        done = Pass(flat, NONE if acting is None else acting, t, x, w, p, taps=self._taps(d)).run()
        sources = [flat.source(*flat.ports[name], done.values) for name in flat.plant_inputs.slices]
        z = ca.vertcat(*(ca.MX(ca.densify(ca.DM(c))) if isinstance(c, np.ndarray) else c for c in sources))
        of_all = ca.vertcat(
            *(done.rates.get(path, ca.MX.zeros(where.stop - where.start)) for path, where in flat.states.slices.items())
        )
        dx = of_all[flat.continuous.tolist()] if flat.continuous.size else ca.MX(0, 1)
        r = ca.vertcat(*(a - b for a, b in done.mismatch)) if done.mismatch else ca.MX(0, 1)
        results = [flat.next_columns(x, done), z, self._measured(done), dx, r]
        jacobians = [ca.densify(ca.jacobian(e, v)) for e in results for v in (x, w, d)]
        f = ca.Function("parts", [t, x, w, p, d], [*map(ca.densify, results), *jacobians])
        self._functions[acting] = f
        return f

    def at(self, acting: frozenset[Clock] | None, t: float, x: np.ndarray, w: np.ndarray) -> dict[str, Any]:
        """Return the values x⁺, z, y, dx and, by name and argument, their derivatives at an instant.

        ``found["z"]`` is a value, ``found["z", "w"]`` the derivative of z by w. Algebraic loops are eliminated by the
        implicit function theorem.
        """
        numbers = self._function(acting).call([t, x, w, self.flat.p, np.zeros(self.n_inputs)])
        names, arguments = ("x", "z", "y", "dx", "r"), ("x", "w", "d")
        found: dict[Any, Any] = {n: np.ravel(np.array(v)) for n, v in zip(names, numbers[:5], strict=True)}
        keys = [(n, a) for n in names for a in arguments]
        for key, value in zip(keys, numbers[5:], strict=True):
            found[key] = np.array(value).reshape(value.shape)
        if self.flat.loops.slices and found["r"].size:
            from ._between import active_loops

            where = active_loops(self.flat, NONE if acting is None else acting)
            solve = np.linalg.inv(found["r", "x"][:, where])
            for n in names[:4]:
                through = found[n, "x"][:, where] @ solve
                for a in arguments:
                    found[n, a] = found[n, a] - through @ found["r", a]
                found[n, "x"][:, where] = 0.0
        return found
