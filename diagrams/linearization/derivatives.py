"""Derivatives of a diagram's functions at an instant, with injected signals and cut wires."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias, TypeVar

import casadi as ca
import numpy as np

from ...blocks.core import Layout, NonFiniteError, UnknownNameError, elements, near
from ...blocks.tracing import size
from ..flat import (
    NONE,
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
from ..results import OperatingPoint, resolve
from ..simulation import Workspace
from ..wiring import Wire, index_of, join, split_entry
from .mean_stairs import NO_STAIRS, Stairs
from .plant_models import PlantModel, model_equations, model_step

T = TypeVar("T")
SLOPE = 2.0**-140
"""Factor of the slopes that imaginary parts carry: so small that its square vanishes beside any value."""
_RESULTS, _ARGUMENTS = ("x", "z", "y", "dx", "v", "r"), ("x", "w", "d", "e")
Numbers: TypeAlias = dict[str | tuple[str, str], np.ndarray]
"""Values by name, ``found["z"]``, and derivatives by name and argument, ``found["z", "w"]``."""


@dataclass(frozen=True)
class Tap:
    """A tap: an output port of a diagram, or entries of it.

    Attributes
    ----------
    name : str
        Name of the wire or port.
    port : (str, str)
        Path of the block, and name of its port.
    entries : tuple of int
        Numbers of the entries in the flat port.
    labels : tuple of str
        Names of the entries.
    entry : tuple of int
        Numbers of the entry that the name asks for, counted from 1; () for the whole.
    """

    name: str
    port: tuple[str, str]
    entries: tuple[int, ...]
    labels: tuple[str, ...]
    entry: tuple[int, ...] = ()


def find_signal(flat: FlatDiagram, name: str) -> Tap:
    """Return the port, or entries of one, that a name of a wire or port denotes.

    Raises
    ------
    UnknownNameError
        If the name denotes none, or several.
    """
    wires, ports = flat.table.names, flat.log.slices
    if not isinstance(name, str):
        raise UnknownNameError(f"found {name!r}; expected the name of a wire, or the path of a port. Give a text.")
    name, entry = split_entry(name, {*wires, *ports})
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
        index_of_entry = index_of(entry, part.shape, full)
        part, labels = part[index_of_entry], labels[index_of_entry]
    flat_labels = tuple(str(e) for e in np.ravel(labels))
    return Tap(name, (wire.block, wire.port), tuple(np.ravel(part).tolist()), flat_labels, entry)


class LocalDerivatives:
    """Exact derivatives of a diagram's functions at a tick and between ticks.

    Parameters
    ----------
    flat : FlatDiagram
        Diagram to differentiate.
    inputs : sequence of Tap
        Ports at which signals d are injected: d is added to the signal of all consumers.
    outputs : sequence of Tap
        Ports whose signals are measured, ahead of the injection.
    openings : sequence of Tap
        Ports behind which the wire is cut. Consumers get the port's value in the closed diagram, as a constant, plus
        the injected signal. The motion therefore stays that of the closed diagram.
    evaluators : mapping, optional
        Evaluators of opaque stages; see `Schedule`.
    stairs : Stairs
        Stairs that are replaced by their mean slopes.
    """

    def __init__(
        self,
        flat: FlatDiagram,
        inputs: Sequence[Tap],
        outputs: Sequence[Tap],
        openings: Sequence[Tap],
        evaluators: Evaluators | None = None,
        stairs: Stairs = NO_STAIRS,
    ):
        self.stairs = stairs
        self.flat, self.inputs, self.outputs, self.openings = flat, inputs, outputs, openings
        lengths = Layout.of({str(i): (len(s.entries),) for i, s in enumerate(inputs)})
        self.n_inputs, self.injected = lengths.total, [*lengths.slices.values()]
        self.cut: dict[tuple[str, str], set[int]] = {}
        for s in openings:
            self.cut.setdefault(s.port, set()).update(s.entries)
        self.evaluators = evaluators
        self._schedules: dict[frozenset[TickPattern], Schedule] = {}
        self._derivatives: dict[frozenset[TickPattern], Derivative] = {}
        taps = [tuple((tap.port, tap.entries) for tap in group) for group in (inputs, outputs, openings)]
        self._taps: tuple[Any, ...] = tuple(taps)
        self._workspace = Workspace(flat, evaluators) if flat.loops.slices else None

    @cached_property
    def varies(self) -> bool:
        """Whether the flow between ticks depends on time, or on algebraic loops."""
        return bool(self.flat.flow.depends("dx", "t").any()) or self._workspace is not None

    @cached_property
    def is_linear(self) -> bool:
        """Whether the flow between ticks is linear in what changes there: its derivatives are constants."""
        made, continuous = self._trace_derivative(NONE), self.flat.continuous.tolist()

        def is_constant() -> bool:
            return made.is_constant("dx", "t") and made.is_constant("dx", "x", continuous)

        return not self.varies and self._kept("linear", NONE, is_constant)

    def _kept(self, name: str, acting: frozenset[TickPattern], make: Callable[[], T]) -> T:
        """Return a function of these taps, made once for all diagrams with the same functions.

        Stairs that are replaced depend on the operating point: functions with them are not kept.
        """
        if self.stairs.stairs:
            return make()
        return self.flat.keep((name, acting, self._taps), make)

    def _make_taps(self, d: ca.MX, c: ca.MX) -> dict[tuple[str, str], Any]:
        """Return a function for each port with an injection or a cut, from its signal to that of the consumers."""
        injected: dict[tuple[str, str], list[tuple[int, int]]] = {}
        for signal, where in zip(self.inputs, self.injected, strict=True):
            places = range(where.start, where.stop)
            injected.setdefault(signal.port, []).extend(zip(signal.entries, places, strict=True))
        cut = Layout.of({join(*port): self.flat.checked.shapes[port] for port in self.cut})
        kept = {port: c[cut.slices[join(*port)]] for port in self.cut}

        def make_tap(port: tuple[str, str]) -> Any:
            def change(column: Any) -> Any:
                column = column if isinstance(column, ca.MX) else ca.MX(ca.DM(column))
                parts = [kept[port][i] if i in self.cut.get(port, ()) else column[i] for i in range(column.numel())]
                for entry, k in injected.get(port, ()):
                    parts[entry] = parts[entry] + d[k]
                return ca.vertcat(*parts)

            return change

        return {port: make_tap(port) for port in {*injected, *self.cut}}

    def _read_outputs(self, done: Instant) -> ca.MX:
        """Return the measured signals, one after the other."""
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

    def _trace_closed(self, acting: frozenset[TickPattern]) -> Schedule:
        """Return ``(t, x, w, p) -> c``, the values of the cut ports in the closed diagram."""

        def make() -> Schedule:
            flat, symbols = self.flat, self.flat.symbols()

            def results(apart: Apart) -> Mapping[str, Any]:
                instant = evaluate(flat, flat.blocks, acting, **symbols, apart=apart)
                return {"c": ca.vertcat(*(ca.densify(ca.MX(instant.values[port])) for port in self.cut))}

            return trace_schedule("closed", symbols, results)

        if acting not in self._schedules:
            self._schedules[acting] = self._kept("closed", acting, make)
        return self._schedules[acting]

    def _trace_derivative(self, acting: frozenset[TickPattern]) -> Derivative:
        """Return values and derivatives by (x, w, d) at an instant; ``NONE`` is one between ticks."""

        def make() -> Derivative:
            flat, symbols = self.flat, self.flat.symbols()
            d, e = ca.MX.sym("d", self.n_inputs), ca.MX.sym("e", self.stairs.e.total)
            c = ca.MX.sym("c", sum(size(flat.checked.shapes[port]) for port in self.cut))

            def results(apart: Apart) -> Mapping[str, Any]:
                instant = evaluate(
                    flat, flat.blocks, acting, **symbols, taps=self._make_taps(d, c), apart=apart,
                    visit=lambda here, path, inputs, made: self.stairs.add(here, path, made, e),
                )  # fmt: skip
                found = {"x_next": next_x(instant), "z": plant_inputs(instant), "y": self._read_outputs(instant)}
                return {**found, "dx": rates(instant), "v": self.stairs.read(instant), "r": loop_mismatch(instant)}

            schedule = trace_schedule("parts", {**symbols, "d": d, "e": e, "c": c}, results)
            return Derivative(schedule, [(name, None) for name in _ARGUMENTS])

        if acting not in self._derivatives:
            self._derivatives[acting] = self._kept("parts", acting, make)
        return self._derivatives[acting]

    def model_step(self, at: OperatingPoint, path: str, z: np.ndarray, h: float, way: str | None) -> PlantModel:
        """Return the linear model of one communication step of an FMU; see `plant_models.model_step`."""
        return model_step(self.flat, at, path, z, h, way)

    def model_equations(self, at: OperatingPoint, way: str | None) -> list[PlantModel]:
        """Return the linear models of the equations of all FMUs; see `plant_models.model_equations`."""
        return model_equations(self.flat, at, way)

    def parts(self, change: np.ndarray, state: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the pairs of a change and a state that both are small where nothing moves."""
        return [(change, state)]

    def _solve_loops(self, acting: frozenset[TickPattern], t: float, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return x with the algebraic loops solved at an instant."""
        return x if self._workspace is None else self._workspace.solve_loops(acting, t, x, w)

    def differentiate(self, acting: frozenset[TickPattern], t: float, x: np.ndarray, w: np.ndarray) -> Numbers:
        """Return the values x⁺ ("x"), z, y and dx at an instant, and their derivatives by x, w and d.

        ``found["z"]`` is a value, ``found["z", "w"]`` the derivative of z by w. Algebraic loops are solved, and
        eliminated by the implicit function theorem.

        Raises
        ------
        NonFiniteError
            If a derivative is not finite, such as that of a square root at zero.
        """
        flat = self.flat
        x = self._solve_loops(acting, t, x, w)
        at = t, x, w, flat.p
        c = self._trace_closed(acting)(*at, evaluators=self.evaluators)[0] if self.cut else np.zeros(0)
        zeros = np.zeros(self.n_inputs), np.zeros(self.stairs.e.total)
        numbers = self._trace_derivative(acting)(*at, *zeros, c, evaluators=self.evaluators)
        return self._eliminate_loops(numbers, acting, t)

    def _eliminate_loops(self, numbers: Sequence[np.ndarray], acting: frozenset[TickPattern], t: float) -> Numbers:
        """Return values and derivatives by name, without algebraic loops and the stairs that are replaced.

        Loops are eliminated by the implicit function theorem.
        """
        names, arguments = _RESULTS, _ARGUMENTS
        keys = [(n, a) for n in names for a in arguments]
        found: Numbers = dict(zip([*names, *keys], numbers, strict=True))
        _check_finite([found[n, a] for n in names for a in arguments], t)
        if found["r"].size:
            where = self.flat.active_loops(acting)
            through_all = np.linalg.solve(
                found["r", "x"][:, where].T, np.vstack([found[n, "x"][:, where] for n in names[:-1]]).T
            ).T
            for n, rows in Layout.of({n: (len(found[n]),) for n in names[:-1]}).slices.items():
                for a in arguments:
                    found[n, a] = found[n, a] - through_all[rows] @ found["r", a]
                found[n, "x"][:, where] = 0.0
        self.stairs.close(found, names[:4], arguments[:3])
        return found


def _check_finite(derivatives: Iterable[np.ndarray], t: float) -> None:
    """Refuse an instant at which a derivative is not finite, such as that of a square root at zero."""
    for derivative in derivatives:
        if not np.all(np.isfinite(derivative)):
            raise NonFiniteError(
                "found a derivative of the diagram's functions that is not finite; expected finite numbers. Linearize "
                "at another instant, or take a block that is smooth there.",
                t=t,
            )
