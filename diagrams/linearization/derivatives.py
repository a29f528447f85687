"""Derivatives of a diagram's functions at an instant, with injected signals and cut wires.

Along a direction of the parameters a number and its slope travel together, as one complex number: the imaginary part is
the slope, times a factor so small that its square vanishes. Sums, products, solutions of linear systems and matrix
exponentials of such numbers have the slopes of their results as imaginary parts, to rounding. So the linear models over
a period, and their slopes along a parameter, are made by the same functions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias, TypeVar, cast

import casadi as ca
import numpy as np

from ...blocks.core import Layout, NonFiniteError, UnknownNameError, elements, near
from ...blocks.tracing import extrapolate, size
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
    size_of_motion,
    trace_schedule,
)
from ..results import OperatingPoint, resolve
from ..simulation import Workspace
from ..wiring import Wire, explain_absent_state, index_of, join, split_entry
from .delay_channels import delay_channels
from .exchanged import evaluators_at
from .mean_stairs import NO_STAIRS, Stairs
from .plant_models import EQUILIBRIUM, PlantModel, model_equations, model_step

T = TypeVar("T")
SLOPE = 2.0**-140
"""Factor of the slopes that imaginary parts carry: so small that its square vanishes next to any value."""
STEP = 2.0**-9
"""Step of a difference of fourth order between models of an FMU, relative to 1 + the size of what moves."""
ROUNDING = 1e-13
"""Change of an FMU's states and inputs by a change of the parameter as large as itself that is rounding alone."""
STILL = 1e3 * EQUILIBRIUM
"""Largest slope of an FMU's rates at which it stays at rest."""
_RESULTS, _ARGUMENTS = ("x", "z", "y", "dx", "v", "r"), ("x", "w", "d", "e")
Numbers: TypeAlias = dict[str | tuple[str, str], np.ndarray]
"""Values by name, ``found["z"]``, and derivatives by name and argument, ``found["z", "w"]``."""


@dataclass(frozen=True)
class Tap:
    """A tap: an output port of a diagram, or entries of it."""

    name: str
    port: tuple[str, str]  # path of the block, and name of its port
    entries: tuple[int, ...]  # numbers of the entries in the flat port
    labels: tuple[str, ...]
    entry: tuple[int, ...] = ()  # numbers of the entry that the name asks for, counted from 1; () for the whole


def wire_entries(flat: FlatDiagram, wire: Wire) -> tuple[int, ...]:
    """Return the numbers of the entries of a port that a wire takes."""
    shape = flat.checked.shapes[wire.block, wire.port]
    every = np.arange(size(shape)).reshape(shape)
    return tuple(np.ravel(every if wire.index is None else every[wire.index]).tolist())


def find_signal(flat: FlatDiagram, name: str) -> Tap:
    """Return the port, or entries of one, that a name of a wire or port denotes."""
    wires, ports = flat.table.names, flat.log.slices
    if not isinstance(name, str):
        raise UnknownNameError(f"found {name!r}; expected the name of a wire, or the path of a port. Give a text.")
    name, entry = split_entry(name, {*wires, *ports})
    try:
        full = resolve(name, wires, ports, flat.table.blocks)
    except UnknownNameError as error:
        if error.candidates:
            raise
        known = {n.rpartition(".")[2] for n in (*wires, *ports)} | {*wires, *ports}
        reason = explain_absent_state(flat.table.blocks, name)
        step = f"{reason[0].upper()}{reason[1:]}" if reason else near(name, known)
        raise UnknownNameError(f"there is no signal {name!r} in this diagram. {step}") from None
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


def join_slope(value: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return numbers that carry slopes."""
    return np.asarray(value + 1j * SLOPE * np.asarray(slope))


def slope_of(numbers: np.ndarray) -> np.ndarray:
    """Return the slopes that numbers carry."""
    return np.asarray(np.imag(numbers) / SLOPE)


class LocalDerivatives:
    """Exact derivatives of a diagram's functions at a tick and between ticks.

    With a ``direction`` of the parameters they carry their slopes along it, as do the operating points that they take.

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
        self.direction: np.ndarray | None = None
        """Direction of the diagram's vector of parameters p, along which slopes are taken."""
        self.scale, self.error = 1.0, 0.0
        """Size of the parameter, and the largest estimated error of a slope that is made of differences."""
        self._made: dict[tuple[str, frozenset[TickPattern]], Any] = {}
        self._plants: dict[tuple[Any, ...], PlantModel] = {}
        taps = [tuple((tap.port, tap.entries) for tap in group) for group in (inputs, outputs, openings)]
        self._taps: tuple[Any, ...] = tuple(taps)
        self._workspace = Workspace(flat, evaluators) if flat.loops.slices else None

    @cached_property
    def varies(self) -> bool:
        """Whether the flow between ticks depends on time, or on algebraic loops."""
        return bool(self.flat.flow.depends("dx", "t").any()) or self._workspace is not None

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
        return self._workspace is None and by_time <= known and flat.keep("jumps in time", does)

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

        return self._workspace is None and self._kept("linear", NONE, is_constant)

    @cached_property
    def has_constant_slopes(self) -> bool:
        """Whether the derivatives between ticks of the rates and of what delays take in are constants there."""
        made, places = self._trace_derivative(NONE), self.flat.continuous.tolist()

        def is_constant() -> bool:
            every = [made.is_constant(result, "t") and made.is_constant(result, "w") for result in ("dx", "z")]
            return all(every) and all(made.is_constant(result, "x", places) for result in ("dx", "z"))

        return self._workspace is None and self._kept("constant", NONE, is_constant)

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

    def _differentiate_closed(self, acting: frozenset[TickPattern]) -> Derivative:
        """Return the function of `_trace_closed` and its derivative by x."""
        return self._kept("closed slopes", acting, lambda: Derivative(self._trace_closed(acting), [("x", None)]))

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
        return x if self._workspace is None else self._workspace.solve_loops(acting, t, x, w)

    def differentiate(self, acting: frozenset[TickPattern], t: float, x: np.ndarray, w: np.ndarray) -> Numbers:
        """Return the values x⁺ ("x"), z, y and dx at an instant, and their derivatives by x, w and d.

        ``found["z"]`` is a value, ``found["z", "w"]`` the derivative of z by w. Algebraic loops are solved, and
        eliminated by the implicit function theorem.
        """
        if self.direction is not None:
            return self._differentiate_along(self.direction, acting, t, x, w)
        x = self._solve_loops(acting, t, x, w)
        at = t, x, w, self.flat.p
        c = self._trace_closed(acting)(*at, evaluators=self.evaluators)[0] if self.cut else np.zeros(0)
        zeros = np.zeros(self.n_inputs), np.zeros(self.stairs.e.total)
        numbers = self._trace_derivative(acting)(*at, *zeros, c, evaluators=self.evaluators)
        return self._eliminate_loops(numbers, acting, t)

    def _differentiate_along(
        self, direction: np.ndarray, acting: frozenset[TickPattern], t: float, x: np.ndarray, w: np.ndarray
    ) -> Numbers:
        """Return the numbers of `differentiate` with their slopes: x and w move with the parameters."""
        flat, dx, dw = self.flat, slope_of(x), slope_of(w)
        x, w = self._solve_loops(acting, t, np.real(x).copy(), np.real(w).copy()), np.real(w).copy()
        at, still = [np.array([t]), x, w, flat.p], np.zeros(1)
        c = dc = np.zeros(0)
        if self.cut or flat.loops.slices:
            closed, loops = self._differentiate_closed(acting), flat.active_loops(acting)

            def follow() -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
                values, slopes, error = closed.along(at, [still, dx, dw, direction], self.evaluators)
                self.error = max(self.error, error)
                return values, slopes

            (c, r, _, by_x), (dc, dr, *_) = follow()
            if r.size:  # the loops' solutions move, too
                dx[loops] -= np.linalg.solve(by_x[:, loops], dr)
                (c, *_), (dc, *_) = follow()
        zeros = [np.zeros(self.n_inputs), np.zeros(self.stairs.e.total)]
        values, slopes, error = self._trace_derivative(acting).along(
            [*at, *zeros, c], [still, dx, dw, direction, *zeros, dc], self.evaluators
        )
        self.error = max(self.error, error)
        both = [join_slope(v, s) for v, s in zip(values, slopes, strict=True)]
        return self._eliminate_loops(both, acting, t)

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
        """Return the pairs of a change and a state that both are small where nothing moves, slopes included."""
        if self.direction is None:
            return [(change, state)]
        return [(np.real(change), np.real(state)), (slope_of(change), slope_of(state))]

    # --- FMUs --------------------------------------------------------------------------------------------------------

    def model_step(self, at: OperatingPoint, path: str, z: np.ndarray, h: float, way: str | None) -> PlantModel:
        """Return the linear model of one communication step of an FMU; see `plant_models.model_step`."""
        if self.direction is None:
            return model_step(self.flat, at, path, z, h, way)
        middle = self._model_step_once(at, path, np.real(z), h, way)

        def follow(way: str) -> PlantModel:
            def model(point: OperatingPoint, inputs: np.ndarray) -> PlantModel:
                return model_step(self.flat, point, path, inputs, h, way)

            return self._follow(middle, at, z, path, model)

        if middle.identified or not middle.derivation.held:
            return follow("identified" if middle.identified else "step")
        made = follow("equations")
        moves = np.max(np.abs(slope_of(made.f - made.x0)), initial=0.0) > STILL
        return follow("step") if moves else made

    def _model_step_once(self, at: OperatingPoint, path: str, z: np.ndarray, h: float, way: str | None) -> PlantModel:
        """Return the linear model of a step without slopes; one that is known from another direction is taken."""
        still = _without_slopes(at)
        point = still.plants[path]
        numbers = [np.ravel(v) for kind in ("state", "inputs") for v in point[kind].values()]
        kept = tuple(v.tobytes() if v.dtype.kind != "O" else tuple(v) for v in numbers)
        key = (path, h, way, point["t"], z.tobytes(), still.w.tobytes(), kept)
        if key not in self._plants:
            self._plants[key] = model_step(self.flat, still, path, z, h, way)
        return self._plants[key]

    def model_equations(self, at: OperatingPoint, way: str | None) -> list[PlantModel]:
        """Return the linear models of the equations of all FMUs; see `plant_models.model_equations`."""
        if self.direction is None:
            return model_equations(self.flat, at, way)
        found = model_equations(self.flat, _without_slopes(at), way)

        def follow(place: int) -> PlantModel:
            def model(point: OperatingPoint, z: np.ndarray) -> PlantModel:
                return model_equations(self.flat, replace(point, z=z), way)[place]

            return self._follow(found[place], at, at.z, found[place].path, model)

        return [follow(place) for place in range(len(found))]

    def _follow(
        self,
        middle: PlantModel,
        at: OperatingPoint,
        z: np.ndarray,
        path: str,
        model: Callable[[OperatingPoint, np.ndarray], PlantModel],
    ) -> PlantModel:
        """Return an FMU's model with its slopes, by differences along those of its states and inputs."""
        point = at.plants[path]
        moving = [*point["state"].values(), *point["inputs"].values(), z[middle.inputs], at.z[middle.inputs]]
        moving.append(at.w[middle.outputs])
        size = max((size_of_motion(np.asarray(v), slope_of(v)) for v in moving), default=0.0)
        if size * self.scale <= ROUNDING:
            return middle

        def shift(s: float) -> PlantModel:
            return model(_moved(at, s / size), np.real(z) + s / size * slope_of(z))

        pairs = [(shift(s), shift(-s)) for s in (STEP, 2.0 * STEP)]

        def slope(value: Any, ends: Sequence[tuple[Any, Any]]) -> Any:
            if isinstance(value, Mapping):
                return {key: slope(value[key], [(a[key], b[key]) for a, b in ends]) for key in value if key != "t"}
            if isinstance(value, str) or np.asarray(value).dtype.kind not in "fc":
                return value
            near, far = (
                (np.asarray(a) - np.asarray(b)) * (size / (2.0 * s))
                for (a, b), s in zip(ends, (STEP, 2.0 * STEP), strict=True)
            )
            self.error = max(self.error, float(np.max(np.abs(near - far), initial=0.0)))
            return join_slope(np.asarray(value), extrapolate(near, far))

        made = {
            name: slope(getattr(middle, name), [(getattr(a, name), getattr(b, name)) for a, b in pairs])
            for name in ("A", "B", "C", "D", "x0", "f", "y_next", "next")
        }
        return replace(middle, **{**made, "next": {**middle.next, **made["next"]}})


def _moved(at: OperatingPoint, s: float) -> OperatingPoint:
    """Return an operating point that has moved by ``s`` along its slopes."""

    def move(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: move(inner) for key, inner in value.items()}
        return np.real(value) + s * slope_of(value) if np.iscomplexobj(value) else value

    x, w, z = (move(v) for v in (at.x, at.w, at.z))
    return replace(at, x=x, w=w, z=z, plants=cast("dict[str, Any]", move(at.plants)))


def _without_slopes(at: OperatingPoint) -> OperatingPoint:
    return _moved(at, 0.0)


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


def find_moving(flat: FlatDiagram, local: LocalDerivatives, at: OperatingPoint) -> tuple[str, ...]:
    """Return the names of injected signals that change between ticks and that continuous blocks use there."""
    late = delay_channels(flat).inputs
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
    local = LocalDerivatives(flat, signals, [], signals, evaluators_at(flat, at))
    names = [*find_moving(flat, local, at), *(s.name for s in sources if is_moving(flat, s))]
    return names[0] if names else ""
