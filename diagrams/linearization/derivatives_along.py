"""Derivatives of a diagram's functions, with their slopes along a direction of the parameters.

A number and its slope travel together, as one complex number: the imaginary part is the slope, times a factor so small
that its square vanishes. Sums, products, solutions of linear systems and matrix exponentials of such numbers have the
slopes of their results as imaginary parts, to rounding. So the linear models over a period are made by the functions
that make them anyway.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import wraps
from typing import Any, ParamSpec, TypeVar, cast
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from ..flat import (
    Apart,
    Derivative,
    FlatDiagram,
    Schedule,
    TickPattern,
    evaluate,
    loop_mismatch,
    size_of_motion,
    trace_schedule,
)
from ..results import OperatingPoint
from .derivatives import SLOPE, LocalDerivatives, Numbers
from .flow_model import EQUILIBRIUM
from .plant_models import PlantModel, model_equations, model_step

P = ParamSpec("P")
T = TypeVar("T")
STEP = 2.0**-9
"""Step of a difference of fourth order between models of an FMU, relative to 1 + the size of what moves."""
ROUNDING = 1e-13
"""Change of an FMU's states and inputs by a change of the parameter as large as itself that is rounding alone."""
STILL = 1e3 * EQUILIBRIUM
"""Largest slope of an FMU's rates at which it stays at rest."""


def once_for_model(find: Callable[P, T]) -> Callable[P, T]:
    """Keep what a method of ``self.model`` finds for a diagram's numbers and a direction, as long as the model lives.

    The method takes ``(self, flat, diagram, direction)``. An equilibrium follows a parameter alike for all loops.
    """
    known: WeakKeyDictionary[Any, dict[tuple[bytes, bytes], T]] = WeakKeyDictionary()

    @wraps(find)
    def found(*args: P.args, **kwargs: P.kwargs) -> T:
        owner, flat, _, direction = cast("tuple[Any, FlatDiagram, Any, np.ndarray]", args)
        of_model = known.setdefault(owner.model, {})
        key = flat.p.tobytes(), direction.tobytes()
        if key not in of_model:
            of_model[key] = find(*args, **kwargs)
        return of_model[key]

    return found


def join_slope(value: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return numbers that carry slopes."""
    return np.asarray(value + 1j * SLOPE * np.asarray(slope))


def slope_of(numbers: np.ndarray) -> np.ndarray:
    """Return the slopes that numbers carry."""
    return np.asarray(np.imag(numbers) / SLOPE)


class DerivativesAlong(LocalDerivatives):
    """Local derivatives whose results carry slopes along a direction of the parameters.

    Attributes
    ----------
    direction : ndarray
        Direction of the diagram's vector of parameters p.
    scale : float
        Size of the parameter.
    error : float
        Largest estimated error of a slope that is made of differences; 0 if all are exact.
    """

    def __init__(self, flat: FlatDiagram, *taps: Any):
        super().__init__(flat, *taps)
        self.direction = np.zeros(flat.p.size)
        self.scale, self.error = 1.0, 0.0
        self._plants: dict[tuple[Any, ...], PlantModel] = {}
        self._closed_slopes: dict[frozenset[TickPattern], Derivative] = {}

    def _trace_closed_slopes(self, acting: frozenset[TickPattern]) -> Derivative:
        """Return ``(t, x, w, p) -> (c, r)`` of the closed diagram, and the derivative by x.

        c are the values of the cut ports, r is the mismatch of the algebraic loops.
        """

        def make() -> Derivative:
            flat, symbols = self.flat, self.flat.symbols()

            def results(apart: Apart) -> Mapping[str, Any]:
                instant = evaluate(flat, flat.blocks, acting, **symbols, apart=apart)
                columns = [ca.densify(ca.MX(instant.values[port])) for port in self.cut]
                return {"c": ca.vertcat(*columns) if columns else ca.MX(0, 1), "r": loop_mismatch(instant)}

            schedule: Schedule = trace_schedule("closed", symbols, results)
            return Derivative(schedule, [("x", None)])

        if acting not in self._closed_slopes:
            self._closed_slopes[acting] = self._kept("closed slopes", acting, make)
        return self._closed_slopes[acting]

    def differentiate(self, acting: frozenset[TickPattern], t: float, x: np.ndarray, w: np.ndarray) -> Numbers:
        """Return the numbers of `LocalDerivatives.differentiate`, with their slopes."""
        flat, dx, dw = self.flat, slope_of(x), slope_of(w)
        x, w = self._solve_loops(acting, t, np.real(x).copy(), np.real(w).copy()), np.real(w).copy()
        at = [np.array([t]), x, w, flat.p]
        c = dc = np.zeros(0)
        if self.cut or flat.loops.slices:
            closed = self._trace_closed_slopes(acting)
            loops = flat.active_loops(acting)

            def follow() -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
                values, slopes, error = closed.along(at, [np.zeros(1), dx, dw, self.direction], self.evaluators)
                self.error = max(self.error, error)
                return values, slopes

            (c, r, _, by_x), (dc, dr, *_) = follow()
            if r.size:
                dx[loops] -= np.linalg.solve(by_x[:, loops], dr)
                (c, *_), (dc, *_) = follow()
        zeros = [np.zeros(self.n_inputs), np.zeros(self.stairs.e.total)]
        values, slopes, error = self._trace_derivative(acting).along(
            [*at, *zeros, c], [np.zeros(1), dx, dw, self.direction, *zeros, dc], self.evaluators
        )
        self.error = max(self.error, error)
        both = [join_slope(v, s) for v, s in zip(values, slopes, strict=True)]
        return self._eliminate_loops(both, acting, t)

    def parts(self, change: np.ndarray, state: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the pairs of a change and a state that both are small where nothing moves, slopes included."""
        return [(np.real(change), np.real(state)), (slope_of(change), slope_of(state))]

    def model_step(self, at: OperatingPoint, path: str, z: np.ndarray, h: float, way: str | None) -> PlantModel:
        """Return the linear model of one communication step of an FMU, with its slopes."""
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
        """Return the linear models of the equations of all FMUs, with their slopes."""
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
            return join_slope(np.asarray(value), (4.0 * near - far) / 3.0)

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
