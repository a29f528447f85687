"""Slopes of a loop's linear model: derivatives of its A, B, C, D by parameters of the diagram.

A parameter of traced equations is a symbol in them: CasADi differentiates the Jacobians once more, along the parameter,
and hold, delay and the time between ticks carry the slopes on (`derivatives`). An FMU's parameter is none: the
linear models of diagrams with changed start values are differenced, with an estimate of the error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal
from weakref import WeakKeyDictionary

import numpy as np

from ...blocks.core import LoopwrightError, ParameterError
from ..flat import NONE, FlatDiagram, WiredDiagram
from ..frequency import FourMatrices, LinearDelays, delayed_system_class
from ..results import OperatingPoint, layout_of
from ..wiring import join
from .delay_channels import delay_channels
from .derivatives import LocalDerivatives
from .derivatives_along import DerivativesAlong, Direction, KnownModels, join_slope, slope_of
from .flow_model import Model, model_continuous
from .linear_model import Linearization
from .over_a_period import begin_loop, lift, model_at
from .plant_models import EQUILIBRIUM, join_matrices, plant_layout
from .taps import find_signal
from .tick_chain import Chain, period_of
from .trim_request import Free, difference, free_parameters, locate, read_value, split_array, spread_nodes

if TYPE_CHECKING:
    from control import StateSpace

STEP = 2.0**-8
"""Step of a difference of fourth order between models or points, relative to the parameter's size."""
SLOPES_ORDER = 14
"""Order of Padé's approximation of delays in the derivatives of a continuous loop's matrices."""
LOST = 1e-6
"""Largest remainder, relative to 1 + the size of the change, with which an equilibrium follows a parameter."""
PointFinder = Callable[[WiredDiagram], OperatingPoint]
"""Function from a diagram to its operating point."""
_RESTS: WeakKeyDictionary[Linearization, dict[tuple[bytes, bytes], OperatingPoint | None]] = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class LoopSlope:
    """A loop's matrices, and their derivatives by one number of a parameter."""

    parameter: str  # path as `Diagram.replace` takes it, with the entry of an array: "pid.poles[2]"
    value: float
    matrices: FourMatrices  # A, B, C, D of L
    slopes: FourMatrices  # their derivatives by the number
    errors: FourMatrices  # estimated errors of the slopes' entries; zeros where they are exact
    rest_lost: bool = False

    @property
    def is_exact(self) -> bool:
        """Whether no difference is part of the slopes."""
        return not any(np.any(error) for error in self.errors)


def differentiate_loop(
    model: Linearization,
    wires: Iterable[str],
    parameters: Iterable[str],
    *,
    find: PointFinder | None = None,
    slow: Literal["closed", "open"] = "closed",
    left_out: dict[str, str] | None = None,
) -> list[LoopSlope]:
    """Return the derivatives of a loop's matrices by parameters, one result for each of their numbers.

    With ``find`` a changed diagram's operating point is found again, and the derivatives count that. Without it, an
    equilibrium follows the parameter, and any other point keeps its states. ``left_out`` takes the messages of
    parameters that have no derivative, by their paths; without it they are errors.
    """
    cut = _Cut(model, tuple(wires), slow)
    found = []
    for name in dict.fromkeys(parameters):
        whole, entry = split_array(model.wired, name)
        try:
            (free,), diagram = free_parameters(model.wired, {whole: None})
            kind = _StartValues if free.where is None else _Traced
            found += kind(cut, free, diagram, find).slopes(free.find_entries(entry))
        except LoopwrightError as error:
            if left_out is None:
                raise
            left_out[name] = error.message
    return found


def loop_of_variant(
    model: Linearization,
    wires: Iterable[str],
    diagram: WiredDiagram,
    at: OperatingPoint,
    *,
    slow: Literal["closed", "open"] = "closed",
) -> tuple[StateSpace, bool]:
    """Return L of a changed diagram at a point, and whether it rests there.

    It is made as by `Linearization.loop`, with the options of a linear model, but not compared with the diagram's
    poles, and without findings: one of many that are compared with one that is.
    """
    from control import StateSpace as System

    diagram = diagram.replace(at.parameters) if at.parameters else diagram
    flat = diagram.flatten_like(at)
    at.check_fits(flat, diagram.name)
    made = _model_at(model, at, diagram.name, *_derivatives(model, flat, at, wires), slow)
    rests = bool(np.max(np.abs(made.affine), initial=0.0) <= EQUILIBRIUM)
    matrices, late = _loop_of(made)
    if late is not None:
        rest = System(*late.join(matrices), 0, remove_useless_states=False)
        return delayed_system_class()(rest, late.times, late.names), rests
    return System(*matrices, made.dt, remove_useless_states=False), rests


def _loop_of(made: Model) -> tuple[FourMatrices, LinearDelays | None]:
    """Return the matrices of the loop L of a diagram that is cut, and its delays: the outputs' sign is the other."""
    A, B, C, D = made.matrices
    n, m = len(A), len(D)
    late = made.delays
    return (A, B.reshape(n, m), -C.reshape(m, n), -D), None if late is None else replace(late, E=-late.E)


def rational_loop(L: Any, order: int = 0) -> Any:
    """Return a loop whose matrices have slopes: with delays, the one with Padé's approximation of order 14.

    Up to ω τ = 6 it is the loop to rounding, up to ω τ = 12 to 1e-7. ``order`` takes another one.
    """
    return L.pade(order or SLOPES_ORDER) if isinstance(L, delayed_system_class()) else L


def _rational_matrices(made: Model, order: int) -> FourMatrices:
    """Return the matrices of `rational_loop`."""
    matrices, late = _loop_of(made)
    return matrices if late is None else late.approximate(matrices, [order or SLOPES_ORDER] * len(late.times))


def _derivatives(
    model: Linearization, flat: FlatDiagram, at: OperatingPoint, wires: Iterable[str]
) -> tuple[LocalDerivatives, LocalDerivatives]:
    """Return the derivatives with a loop cut at wires, and with all closed."""
    taps = [find_signal(flat, w) for w in wires]
    local, closed = (LocalDerivatives.at(flat, at, t, t, t, model.stairs) for t in (taps, []))
    return local, closed


def _model_at(
    model: Linearization,
    at: OperatingPoint,
    name: str,
    local: LocalDerivatives,
    closed: LocalDerivatives,
    slow: Literal["closed", "open"],
) -> Model:
    """Return the model of a cut loop; ``closed`` are the derivatives with nothing cut, ``name`` is the diagram's."""
    frozen = NONE
    if model.dt:
        at, frozen = begin_loop(closed, at, [tap.port for tap in local.inputs], model.plants, slow, name)
    made, _ = model_at(
        local, at, model.plants, name, discrete=bool(model.dt), loop="one", frozen=frozen, with_findings=False
    )
    return made


class _Cut:
    """A loop cut at wires, as a function of the diagram and its operating point."""

    def __init__(self, model: Linearization, wires: tuple[str, ...], slow: Literal["closed", "open"]):
        self.model, self.wires, self.slow = model, wires, slow
        self.flat = model.wired.flatten_like(model.point)
        self._known: dict[int, tuple[FlatDiagram, tuple[LocalDerivatives, LocalDerivatives], KnownModels]] = {}

    def along(self, flat: FlatDiagram, direction: Direction) -> tuple[DerivativesAlong, DerivativesAlong]:
        """Return the derivatives along a direction with the loop cut, and with all closed; their traces are kept."""
        if id(flat) not in self._known:
            self._known[id(flat)] = flat, _derivatives(self.model, flat, self.model.point, self.wires), {}
        _, (local, closed), models = self._known[id(flat)]
        return DerivativesAlong(local, direction, models), DerivativesAlong(closed, direction, models)

    def loop(
        self, flat: FlatDiagram, diagram: WiredDiagram, at: OperatingPoint, direction: Direction
    ) -> tuple[FourMatrices, float]:
        """Return A, B, C, D of L with slopes along a direction, at a point with slopes, and the slopes' error."""
        local, closed = self.along(flat, direction)
        made = _model_at(self.model, at, diagram.name, local, closed, self.slow)
        return _rational_matrices(made, self.model.pade), max(local.error, closed.error)

    def rest(self, flat: FlatDiagram, diagram: WiredDiagram, direction: Direction) -> OperatingPoint | None:
        """Return the point with the slopes of the equilibrium that follows a parameter; None if none follows.

        It is kept as long as the model lives: it follows a parameter alike for all loops.
        """
        known, key = _RESTS.setdefault(self.model, {}), (flat.p.tobytes(), direction.by_p.tobytes())
        if key not in known:
            known[key] = self._find_rest(flat, diagram, direction)
        return known[key]

    def _find_rest(self, flat: FlatDiagram, diagram: WiredDiagram, direction: Direction) -> OperatingPoint | None:
        """Return the point of `rest`.

        The equations are x = f(x, p) over a period, so that (1 − ∂f/∂x) x′ = ∂f/∂p. The smallest solution is taken:
        states that nothing determines, as those of an integrator at rest, stay.
        """
        at, model = self.model.point, self.model
        _, closed = self.along(flat, direction)
        start = replace(at, x=join_slope(at.x, np.zeros(at.x.size)))
        if not model.dt:
            made = model_continuous(closed, start, model.plants, diagram.name)
            if at.plants:  # the outputs of FMUs in continuous time are not followed
                return start if np.max(np.abs(slope_of(made.affine)), initial=0.0) <= LOST else None
            A, late, w = np.real(made.matrices[0]), made.delays, np.zeros(at.w.size)
            if late is not None:  # at rest a delay puts out what it takes in
                A = A + np.real(late.G @ late.settle(late.Z))
            moved = _smallest(A, -slope_of(made.affine))
            if moved is None:
                return None
            x = np.zeros(at.x.size)
            x[flat.continuous] = moved
            if late is not None:
                channels = delay_channels(flat)
                z = slope_of(closed.differentiate(NONE, at.t, start.x, start.w)["z"])[channels.inputs]
                w[channels.outputs] = np.real(late.settle(late.Z @ moved + z))
                return replace(at, x=join_slope(at.x, x), w=join_slope(at.w, w))
            return replace(at, x=join_slope(at.x, x))
        chain = Chain(closed, start, model.plants, period_of(flat))
        chain.go_on()
        M = np.real(lift(chain.steps, each_tick=False)[0])
        moved = _smallest(M - np.eye(len(M)), -slope_of(chain.affine()))
        if moved is None:
            return None
        x, of_plants, z = np.split(moved, np.cumsum([flat.width, chain.n_p]))
        z = z[: flat.plant_inputs.total]
        C, D = (np.real(join_matrices(flat, chain.models, which)) for which in "CD")
        w, channels = C @ of_plants + D @ z, delay_channels(flat)
        w[channels.outputs] = z[channels.inputs]  # at rest a delay puts out what it takes in
        return _with_slopes(flat, at, x, w, of_plants, z, chain)


def _smallest(M: np.ndarray, right: np.ndarray) -> np.ndarray | None:
    """Return the smallest solution of M x = right; None if there is none."""
    if not np.any(right):
        return np.zeros(M.shape[1])
    found = np.linalg.lstsq(M, right, rcond=1e-12)[0]
    left = np.max(np.abs(M @ found - right), initial=0.0)
    return found if left <= LOST * (np.max(np.abs(right)) + np.max(np.abs(M), initial=0.0)) else None


def _with_slopes(
    flat: FlatDiagram,
    at: OperatingPoint,
    x: np.ndarray,
    w: np.ndarray,
    of_plants: np.ndarray,
    z: np.ndarray,
    chain: Chain,
) -> OperatingPoint:
    """Return an operating point with the slopes of its vectors, and of the states and inputs of FMUs."""
    plants, first = dict(at.plants), 0
    layouts = plant_layout(flat.table.blocks, at.plants).of_block
    for m in chain.models:
        point = at.plants[m.path]
        own, first = of_plants[first : first + len(m.A)], first + len(m.A)
        state, inputs = dict(point["state"]), dict(point["inputs"])
        if not m.identified:
            for name, slope in layouts[m.path].split(own).items():
                state[name] = join_slope(np.asarray(state[name]), slope)
        for port, value in inputs.items():
            where = flat.plant_inputs.slices.get(join(m.path, port))
            if where is not None:
                inputs[port] = join_slope(np.asarray(value), z[where].reshape(np.shape(value)))
        plants[m.path] = {**point, "state": state, "inputs": inputs}
    return replace(at, x=join_slope(at.x, x), w=join_slope(at.w, w), z=join_slope(at.z, z), plants=plants)


@dataclass(frozen=True)
class _Changed:
    """Diagrams with changed values of one number of a parameter, for `difference`."""

    h: float
    nodes: tuple[float, ...]
    diagrams: list[WiredDiagram]

    @classmethod
    def of(cls, free: Free, value: np.ndarray, i: int, diagram: WiredDiagram) -> _Changed:
        middle = float(value[i])
        h, nodes = spread_nodes(middle, STEP * (abs(middle) or 1.0), free.low[i], free.high[i])
        changed = []
        for place in nodes:
            moved = value.copy()
            moved[i] = middle + place * h
            changed.append(diagram.replace({free.name: free.shape_value(moved)}))
        return cls(h, nodes, changed)

    def slope(self, middle: Any, others: Iterable[Any]) -> tuple[np.ndarray, np.ndarray]:
        """Return the slope of a value of the diagram and its errors, from its values in the changed diagrams."""
        return difference([middle, *others], self.h, self.nodes)


def _with_differences(
    at: OperatingPoint, points: Sequence[OperatingPoint], changed: _Changed
) -> tuple[OperatingPoint, float]:
    """Return an operating point with its slopes, from those of changed diagrams, and their largest error."""
    worst = 0.0

    def slope(here: Any, others: Sequence[Any]) -> Any:
        nonlocal worst
        if isinstance(here, Mapping):
            return {key: value if key == "t" else slope(value, [o[key] for o in others]) for key, value in here.items()}
        if isinstance(here, str) or np.asarray(here).dtype.kind != "f":
            return here
        found, error = changed.slope(here, others)
        worst = max(worst, float(np.max(error, initial=0.0)))
        return join_slope(np.asarray(here), found)

    parts = {name: slope(getattr(at, name), [getattr(p, name) for p in points]) for name in ("x", "w", "z", "plants")}
    return replace(at, **parts), worst


class _StartValues:
    """Slopes along an FMU's parameter, a start value: differences of linear models."""

    def __init__(self, cut: _Cut, free: Free, diagram: WiredDiagram, find: PointFinder | None):
        self.cut, self.free, self.find = cut, free, find

    def slopes(self, entries: Sequence[tuple[int, str]]) -> list[LoopSlope]:
        free, model = self.free, self.cut.model
        found, value = [], free.start
        middle = self._loop(model.wired, model.point)[0]
        for i, name in entries:
            changed = _Changed.of(free, value, i, model.wired)
            made = [self._loop(d, model.point if self.find is None else self.find(d)) for d in changed.diagrams]
            if any([np.shape(M) for M in four] != [np.shape(M) for M in middle] for four, _ in made):
                raise ParameterError(
                    "found a value that changes the number of states of the loop; expected the same states. Try "
                    "values with diagram.replace(…), one after the other.",
                    block=free.path,
                    port=name,
                )
            both = [changed.slope(M, [four[k] for four, _ in made]) for k, M in enumerate(middle)]
            (A, B, C, D), (eA, eB, eC, eD) = zip(*both, strict=True)
            lost = model.is_equilibrium and not all(rests for _, rests in made)
            found.append(LoopSlope(name, float(value[i]), middle, (A, B, C, D), (eA, eB, eC, eD), lost))
        return found

    def _loop(self, diagram: WiredDiagram, at: OperatingPoint) -> tuple[FourMatrices, bool]:
        """Return A, B, C, D of the loop of a diagram, and whether its point is an equilibrium."""
        L, rests = loop_of_variant(self.cut.model, self.cut.wires, diagram, at, slow=self.cut.slow)
        L = rational_loop(L, self.cut.model.pade)
        return (L.A, L.B, L.C, L.D), rests


class _Traced:
    """Slopes along the numbers of a parameter of traced equations."""

    def __init__(self, cut: _Cut, free: Free, diagram: WiredDiagram, find: PointFinder | None):
        self.cut, self.free, self.find = cut, free, find
        model = cut.model
        _, keys = free.path, free.keys
        self.value = np.ravel(
            np.asarray(read_value(model.wired.structure.blocks[free.path], keys, free.path), dtype=float)
        )
        self.shape = free.shape
        if np.array_equal(self.value, free.start):  # no zero, which a trace takes for structure
            self.diagram, self.flat = model.wired, cut.flat
            free.where, free.pack = None, None
            locate(free, self.diagram, self.flat)
        else:
            self.diagram, flat = diagram, diagram.flatten_like(model.point)
            if layout_of(flat) != layout_of(cut.flat):
                raise ParameterError(
                    "found 0, which is structure of the block: with another value it has other states; expected a "
                    f"number. Look at small ones: diagram.replace({{{free.name!r}: …}}).",
                    block=free.path,
                    port=".".join(keys),
                )
            p = flat.p.copy()
            locate(free, diagram, flat)
            assert free.where is not None
            p[free.where] = free.pack_value(self.value)
            self.flat = replace(flat, p=p)
            model.point.check_fits(self.flat, model.wired.name)

    def slopes(self, entries: Sequence[tuple[int, str]]) -> list[LoopSlope]:
        free, cut = self.free, self.cut
        found = []
        packed, error = free.slope(self.value)
        for i, name in entries:
            by_p = np.zeros(self.flat.p.size)
            by_p[free.where] = packed[:, i]
            direction = Direction(by_p, abs(float(self.value[i])) or 1.0)
            at, error_of_point, lost = self._point(direction, i)
            four, error_of_models = cut.loop(self.flat, self.diagram, at, direction)
            if not all(np.isfinite(np.concatenate([np.ravel(M) for M in four]))):
                raise ParameterError(
                    f"found a derivative that is not finite at the value {self.value[i]:g}; expected a smooth "
                    "dependence. Take another value, with diagram.replace(…).",
                    block=free.path,
                    port=name,
                )
            (A, B, C, D), (dA, dB, dC, dD) = map(np.real, four), map(slope_of, four)
            worst = max(error_of_models, error_of_point, float(error[i]))
            eA, eB, eC, eD = (worst * (slope != 0.0) for slope in (dA, dB, dC, dD))
            found.append(LoopSlope(name, float(self.value[i]), (A, B, C, D), (dA, dB, dC, dD), (eA, eB, eC, eD), lost))
        return found

    def _point(self, direction: Direction, i: int) -> tuple[OperatingPoint, float, bool]:
        """Return the point with slopes, the error of the slopes, and whether an equilibrium is lost."""
        at = self.cut.model.point
        still = replace(at, x=join_slope(at.x, np.zeros(at.x.size)))
        if self.find is not None:
            changed = _Changed.of(self.free, self.value, i, self.cut.model.wired)
            return (*_with_differences(at, [self.find(d) for d in changed.diagrams], changed), False)
        if self.cut.model.is_equilibrium:
            moved = self.cut.rest(self.flat, self.diagram, direction)
            return (still, 0.0, True) if moved is None else (moved, 0.0, False)
        return still, 0.0, False
