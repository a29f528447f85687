"""Slopes of a diagram's derivatives along a direction of its parameters.

A number and its slope travel together, as one complex number: the imaginary part is the slope, times a factor so small
that its square vanishes. Sums, products, solutions of linear systems and matrix exponentials of such numbers have the
slopes of their results as imaginary parts, to rounding. So the linear models over a period, and their slopes along a
parameter, are made by the same functions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias, cast

import numpy as np

from ...blocks.tracing import extrapolate
from ..flat import Derivative, TickPattern, size_of_motion
from ..results import OperatingPoint
from .derivatives import LocalDerivatives, Numbers
from .plant_models import EQUILIBRIUM, PlantModel, model_equations, model_step

SLOPE = 2.0**-140
"""Factor of the slopes that imaginary parts carry: so small that its square vanishes next to any value."""
STEP = 2.0**-9
"""Step of a difference of fourth order between models of an FMU, relative to 1 + the size of what moves."""
ROUNDING = 1e-13
"""Change of an FMU's states and inputs by a change of the parameter as large as itself that is rounding alone."""
STILL = 1e3 * EQUILIBRIUM
"""Largest slope of an FMU's rates at which it stays at rest."""
KnownModels: TypeAlias = dict[tuple[Any, ...], PlantModel]
"""Models of FMUs' steps by all that they depend on, which are the same along all directions."""


def join_slope(value: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return numbers that carry slopes."""
    return np.asarray(value + 1j * SLOPE * np.asarray(slope))


def slope_of(numbers: np.ndarray) -> np.ndarray:
    """Return the slopes that numbers carry."""
    return np.asarray(np.imag(numbers) / SLOPE)


class Direction(NamedTuple):
    """A direction in which one number of a parameter grows."""

    by_p: np.ndarray  # change of the diagram's vector p for a change of the number by 1
    scale: float  # size of the number


class DerivativesAlong(LocalDerivatives):
    """Derivatives with their slopes along a direction of the parameters; operating points that it takes have slopes."""

    def __init__(self, still: LocalDerivatives, direction: Direction, known: KnownModels):
        super().__init__(still.flat, still.inputs, still.outputs, still.openings, still.evaluators, still.stairs)
        self.direction, self._known = direction, known
        self.workspace = still.workspace
        self.error = 0.0
        """Largest estimated error of a slope that is made of differences, so far."""

    def differentiate(self, acting: frozenset[TickPattern], t: float, x: np.ndarray, w: np.ndarray) -> Numbers:
        """Return the numbers that `LocalDerivatives` gives with their slopes: x and w move with the parameters."""
        flat, dx, dw = self.flat, slope_of(x), slope_of(w)
        x, w = self._solve_loops(acting, t, np.real(x).copy(), np.real(w).copy()), np.real(w).copy()
        at, still = [np.array([t]), x, w, flat.p], np.zeros(1)
        c = dc = np.zeros(0)
        if self.cut or flat.loops.slices:
            closed, loops = self._differentiate_closed(acting), flat.active_loops(acting)

            def follow() -> tuple[Sequence[np.ndarray], Sequence[np.ndarray]]:
                values, slopes, error = closed.along(at, [still, dx, dw, self.direction.by_p], self.evaluators)
                self.error = max(self.error, error)
                return values, slopes

            (c, r, _, by_x), (dc, dr, *_) = follow()
            if r.size:  # the loops' solutions move, too
                dx[loops] -= np.linalg.solve(by_x[:, loops], dr)
                (c, *_), (dc, *_) = follow()
        zeros = [np.zeros(self.n_inputs), np.zeros(self.stairs.e.total)]
        values, slopes, error = self._trace_derivative(acting).along(
            [*at, *zeros, c], [still, dx, dw, self.direction.by_p, *zeros, dc], self.evaluators
        )
        self.error = max(self.error, error)
        both = [join_slope(v, s) for v, s in zip(values, slopes, strict=True)]
        return self._eliminate_loops(both, acting, t)

    def _differentiate_closed(self, acting: frozenset[TickPattern]) -> Derivative:
        """Return the function of `_trace_closed` and its derivative by x."""
        return self._kept("closed slopes", acting, lambda: Derivative(self._trace_closed(acting), [("x", None)]))

    def parts(self, change: np.ndarray, state: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the pairs of a change and a state that both are small where nothing moves: values, and slopes."""
        return [(np.real(change), np.real(state)), (slope_of(change), slope_of(state))]

    # --- FMUs --------------------------------------------------------------------------------------------------------

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
        if key not in self._known:
            self._known[key] = model_step(self.flat, still, path, z, h, way)
        return self._known[key]

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
        if size * self.direction.scale <= ROUNDING:
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
