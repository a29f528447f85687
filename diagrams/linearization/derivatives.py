"""Derivatives of a diagram's functions at an instant, with injected signals and cut wires."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, TypeAlias, TypeVar, cast

import casadi as ca
import numpy as np

from ...blocks.core import Layout, NonFiniteError
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
    WiredDiagram,
    announcers,
    evaluate,
    loop_mismatch,
    next_x,
    plant_inputs,
    rates,
    trace_schedule,
)
from ..results import OperatingPoint
from ..simulation import Workspace
from ..wiring import join
from .delay_channels import delay_channels
from .exchanged import evaluators_at
from .mean_stairs import NO_STAIRS, Stairs, replace_stairs
from .plant_models import PlantModel, model_equations, model_step
from .taps import Tap, find_signal

T = TypeVar("T")
_RESULTS, _ARGUMENTS = ("x", "z", "y", "dx", "v", "r"), ("x", "w", "d", "e")
Numbers: TypeAlias = dict[str | tuple[str, str], np.ndarray]
"""Values by name, ``found["z"]``, and derivatives by name and argument, ``found["z", "w"]``."""


class LocalDerivatives:
    """Exact derivatives of a diagram's functions at a tick and between ticks.

    Signals d are injected at the ``inputs``: they are added for all consumers. ``outputs`` are measured ahead of the
    injection. Behind the ``openings`` the wire is cut: consumers get the port's value in the closed diagram, as a
    constant, plus the injected signal. The motion therefore stays that of the closed diagram.
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
        self._made: dict[tuple[str, frozenset[TickPattern]], Any] = {}
        taps = [tuple((tap.port, tap.entries) for tap in group) for group in (inputs, outputs, openings)]
        self._taps: tuple[Any, ...] = tuple(taps)

    @classmethod
    def at(
        cls,
        flat: FlatDiagram,
        at: OperatingPoint,
        inputs: Sequence[Tap] = (),
        outputs: Sequence[Tap] = (),
        openings: Sequence[Tap] = (),
        stairs: str | None = "zero",
    ) -> LocalDerivatives:
        """Return the derivatives at an operating point, with its FMUs in model exchange and means of its stairs."""
        return cls(flat, inputs, outputs, openings, evaluators_at(flat, at), replace_stairs(flat, at, stairs))

    @cached_property
    def workspace(self) -> Workspace | None:
        """The workspace in which algebraic loops are solved; None without loops."""
        return Workspace(self.flat, self.evaluators) if self.flat.loops.slices else None

    @cached_property
    def varies(self) -> bool:
        """Whether the flow between ticks depends on time, or on algebraic loops."""
        return bool(self.flat.flow.depends("dx", "t").any()) or self.workspace is not None

    @cached_property
    def jumps_in_time(self) -> bool:
        """Whether the flow between ticks depends on time by jumps alone, at instants that its blocks announce."""
        flat, known = self.flat, {path for path, _ in announcers(self.flat)}

        def does() -> bool:
            return Derivative(flat.flow, [("t", None)]).is_zero("dx", "t")

        by_time = {
            path
            for path, trace in flat.checked.traced.items()
            if not flat.table.is_sampled(flat.table.subsystem_of[path])
            and any("t" in d for d in trace.depends.values())
        }
        return self.workspace is None and by_time <= known and flat.keep("jumps in time", does)

    def stays_until(self, t: float) -> float:
        """Return the time until which the flow between ticks does not depend on time from t on; t where it does."""
        if not self.varies:
            return math.inf
        if not self.jumps_in_time:
            return t
        return min((source.next_instant(t) for _, source in announcers(self.flat)), default=math.inf)

    @cached_property
    def is_linear(self) -> bool:
        """Whether the flow between ticks is linear in what changes there: its derivatives are constants."""
        made, continuous = self._trace_derivative(NONE), self.flat.continuous.tolist()

        def is_constant() -> bool:
            return made.is_constant("dx", "t") and made.is_constant("dx", "x", continuous)

        return self.workspace is None and self._kept("linear", NONE, is_constant)

    @cached_property
    def has_constant_slopes(self) -> bool:
        """Whether the derivatives between ticks of the rates and of what delays take in are constants there."""
        made, places = self._trace_derivative(NONE), self.flat.continuous.tolist()

        def is_constant() -> bool:
            every = [made.is_constant(result, "t") and made.is_constant(result, "w") for result in ("dx", "z")]
            return all(every) and all(made.is_constant(result, "x", places) for result in ("dx", "z"))

        return self.workspace is None and self._kept("constant", NONE, is_constant)

    def _kept(self, name: str, acting: frozenset[TickPattern], make: Callable[[], T]) -> T:
        """Return a function of these taps, made once for all diagrams with the same functions.

        The slopes of stairs that are replaced depend on the operating point, their places don't.
        """
        if (name, acting) not in self._made:
            self._made[name, acting] = self.flat.keep((name, acting, self._taps, self.stairs.places), make)
        return cast("T", self._made[name, acting])

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
        """Return ``(t, x, w, p) -> (c, r)`` of the closed diagram.

        c are the values of the cut ports, r is the mismatch of the algebraic loops.
        """

        def make() -> Schedule:
            flat, symbols = self.flat, self.flat.symbols()

            def results(apart: Apart) -> Mapping[str, Any]:
                instant = evaluate(flat, flat.blocks, acting, **symbols, apart=apart, begun=True)
                columns = [ca.densify(ca.MX(instant.values[port])) for port in self.cut]
                return {"c": ca.vertcat(*columns) if columns else ca.MX(0, 1), "r": loop_mismatch(instant)}

            return trace_schedule("closed", symbols, results)

        return self._kept("closed", acting, make)

    def _trace_parts(self, acting: frozenset[TickPattern], *, with_stairs: bool = False) -> Schedule:
        """Return the values at an instant by (t, x, w, p, d, e, c); with the stairs' own values where asked for."""
        flat, symbols = self.flat, self.flat.symbols()
        d, e = ca.MX.sym("d", self.n_inputs), ca.MX.sym("e", self.stairs.e.total)
        c = ca.MX.sym("c", sum(size(flat.checked.shapes[port]) for port in self.cut))

        def results(apart: Apart) -> Mapping[str, Any]:
            own: dict[int, Any] = {}
            instant = evaluate(
                flat,
                flat.blocks,
                acting,
                **symbols,
                taps=self._make_taps(d, c),
                apart=apart,
                begun=True,
                visit=lambda here, path, inputs, made: own.update(self.stairs.add(here, path, made, e)),
            )
            found = {"x_next": next_x(instant), "z": plant_inputs(instant), "y": self._read_outputs(instant)}
            found |= {"dx": rates(instant), "v": self.stairs.read(instant), "r": loop_mismatch(instant)}
            if with_stairs:
                found["s"] = self.stairs.join(own)
            return found

        return trace_schedule("parts", {**symbols, "d": d, "e": e, "c": c}, results)

    def evaluate(
        self,
        acting: frozenset[TickPattern],
        t: float,
        x: np.ndarray,
        w: np.ndarray,
        stairs_from: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> Numbers:
        """Return the values of `differentiate` without their derivatives, and more of stairs that are replaced.

        ``stairs_from`` are inputs v and own values s of the stairs at another instant, from which they continue by
        their mean slope. Without it they have their own values.
        """
        names, zeros = (*_RESULTS, "s"), np.zeros(self.n_inputs)
        x = self._solve_loops(acting, t, x, w)
        at = t, x, w, self.flat.p
        c = self._trace_closed(acting)(*at, evaluators=self.evaluators)[0] if self.cut else np.zeros(0)
        schedule = self._kept("values", acting, lambda: self._trace_parts(acting, with_stairs=True))
        e = np.zeros(self.stairs.e.total)
        for _ in range(len(self.stairs.stairs) + 1):  # a stair may follow another one
            found: Numbers = dict(zip(names, schedule(*at, zeros, e, c, evaluators=self.evaluators), strict=True))
            new = e
            if stairs_from is not None:
                new = self.stairs.K @ (found["v"] - stairs_from[0]) - (found["s"] - stairs_from[1])
            if np.array_equal(new, e):
                break
            e = new
        return found

    def _trace_derivative(self, acting: frozenset[TickPattern]) -> Derivative:
        """Return values and derivatives by (x, w, d) at an instant; ``NONE`` is one between ticks."""
        by = [(name, None) for name in _ARGUMENTS]
        return self._kept("parts", acting, lambda: Derivative(self._trace_parts(acting), by))

    def _solve_loops(self, acting: frozenset[TickPattern], t: float, x: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return x with the algebraic loops solved at an instant."""
        return x if self.workspace is None else self.workspace.solve_loops(acting, t, x, w)

    def differentiate(self, acting: frozenset[TickPattern], t: float, x: np.ndarray, w: np.ndarray) -> Numbers:
        """Return the values x⁺ ("x"), z, y and dx at an instant, and their derivatives by x, w and d.

        ``found["z"]`` is a value, ``found["z", "w"]`` the derivative of z by w. Algebraic loops are solved, and
        eliminated by the implicit function theorem.
        """
        x = self._solve_loops(acting, t, x, w)
        at = t, x, w, self.flat.p
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

    def parts(self, change: np.ndarray, state: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the pairs of a change and a state that both are small where nothing moves."""
        return [(change, state)]

    def model_step(self, at: OperatingPoint, path: str, z: np.ndarray, h: float, way: str | None) -> PlantModel:
        """Return the linear model of one communication step of an FMU; see `plant_models.model_step`."""
        return model_step(self.flat, at, path, z, h, way)

    def model_equations(self, at: OperatingPoint, way: str | None) -> list[PlantModel]:
        """Return the linear models of the equations of all FMUs; see `plant_models.model_equations`."""
        return model_equations(self.flat, at, way)


def _check_finite(derivatives: Iterable[np.ndarray], t: float) -> None:
    """Refuse an instant at which a derivative is not finite, such as that of a square root at zero."""
    for derivative in derivatives:
        if not np.all(np.isfinite(derivative)):
            raise NonFiniteError(
                "found a derivative of the diagram's functions that is not finite; expected finite numbers. Linearize "
                "at another instant, or take a block that is smooth there.",
                t=t,
            )


# --- signals that change between ticks -------------------------------------------------------------------------------


def find_moving(local: LocalDerivatives, at: OperatingPoint) -> tuple[str, ...]:
    """Return the names of injected signals that change between ticks and that continuous blocks use there."""
    flat, late = local.flat, delay_channels(local.flat).inputs
    if not flat.continuous.size and not late.size:
        return ()
    J = local.differentiate(NONE, at.t, at.x, at.w)
    by_d = np.vstack([J["dx", "d"], J["z", "d"][late]])
    injected = zip(local.inputs, local.injected, strict=True)
    return tuple(signal.name for signal, where in injected if np.any(by_d[:, where]) and is_moving(flat, signal))


def is_moving(flat: FlatDiagram, signal: Tap) -> bool:
    """Whether a signal follows continuous states between two ticks."""
    output, late = flat.output(signal.port), delay_channels(flat).outputs
    if output.depends("y", "x")[:, flat.continuous].any():
        return True
    return bool(late.size and output.depends("y", "w")[:, late].any())


def moves_between_ticks(diagram: WiredDiagram, at: OperatingPoint, outputs: list[str], inputs: list[str]) -> str:
    """Return the name of a signal around a plant that changes between the ticks of a sampled diagram, or "".

    These are outputs of the plant that other continuous blocks follow between the ticks, and inputs of the plant that
    are not held.
    """
    flat = diagram.flatten_like(at)
    signals, sources = ([find_signal(flat, name) for name in names] for names in (outputs, inputs))
    local = LocalDerivatives.at(flat, at, signals, openings=signals)
    names = [*find_moving(local, at), *(s.name for s in sources if is_moving(flat, s))]
    return names[0] if names else ""
