"""FMUs in a trim: rates and outputs with their derivatives, from linear models."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ...blocks.core import FmuError, SimulationError, elements
from ...fmus.fmu_block import FmuLinearization, linearize_fmu
from ..flat import Evaluators, FlatDiagram, WiredDiagram
from ..results import OperatingPoint
from ..wiring import change_parameter, join
from .delay_channels import delay_channels
from .exchanged import evaluators_at, load_evaluators
from .identification import WATCHED, output_drift
from .plant_models import PlantModel, join_matrices, plant_entries, plant_layout, plant_model, plant_point

if TYPE_CHECKING:
    from ...fmus.fmu_block import Fmu
    from .trim_request import Free


RELATIVE_STEP = 1e-5
"""Step of a difference by a free parameter, relative to its size or that of its first value."""


@dataclass(eq=False)
class PlantValues:
    """Rates f and outputs y of all FMUs, and their derivatives by states, by z and by free parameters q.

    f is the change over a step for an FMU that does not give its rates.
    """

    f: np.ndarray
    y: np.ndarray
    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    f_by_q: np.ndarray
    y_by_q: np.ndarray


class Plants:
    """All FMUs of a diagram, with their states one after the other."""

    def __init__(self, flat: FlatDiagram, at: OperatingPoint, diagram: WiredDiagram, *, rest: bool):
        self.flat, self.at_start, self.h, self.rest = flat, at, float(flat.base), rest
        self.blocks = {path: cast("Fmu", diagram.blocks[path]) for path in sorted(at.plants)}
        self.delays = delay_channels(flat)
        self.states = plant_layout(self.blocks, at.plants)
        self.own = self.states.slices
        self.by_step = {path: self._needs_step(path) for path in self.blocks}
        self.x0 = np.zeros(self.states.total)
        for path, layout in self.states.of_block.items():
            for name, where in layout.slices.items():
                self.x0[where] = np.ravel(at.plants[path]["state"][name])

    @property
    def equations(self) -> list[str]:
        """Names of the equations of the FMUs' states: of rates, or of changes over a step."""
        return [
            f"{label} per step" if self.by_step[path] else f"d/dt {label}"
            for path, layout in self.states.of_block.items()
            for name, shape in layout.shapes.items()
            for label in elements(join(path, name), shape)
        ]

    @property
    def total(self) -> int:
        """Number of states of all FMUs."""
        return self.x0.size

    @property
    def seconds(self) -> np.ndarray:
        """Time over which f is the change of a state, for every state: 1 s for a rate, or a step."""
        found = np.ones(self.total)
        for path, where in self.own.items():
            found[where] = self.h if self.by_step[path] else 1.0
        return found

    def _needs_step(self, path: str) -> bool:
        """Whether an FMU does not give its rates."""
        try:
            self._linearize(self.blocks[path], self.at_start.plants[path], step=False)
        except FmuError:
            return True
        return False

    def _linearize(self, block: Fmu, point: Mapping[str, Any], *, step: bool) -> FmuLinearization:
        here = {name: point[name] for name in ("t", "state", "inputs")}
        return linearize_fmu(block, h=self.h if step else None, **here)

    def point(self, path: str, block: Fmu, xp: np.ndarray, z: np.ndarray) -> dict[str, Any]:
        """Return time, states and inputs of an FMU, the arguments of its linear models."""
        now = plant_point(self.flat, self.at_start, path, z)
        inputs = dict(now["inputs"])
        for port, variable in block.input_variables.items():
            if variable.name in block.start and join(path, port) not in self.flat.plant_inputs.slices:
                inputs[port] = np.reshape(block.start[variable.name], np.shape(inputs[port]))
        state = {**now["state"], **self.states.of_block[path].split(xp)}
        return {"t": now["t"], "state": state, "inputs": inputs}

    def points(self, xp: np.ndarray, z: np.ndarray, changed: Mapping[str, Fmu]) -> dict[str, Any]:
        """Return time, states and inputs of all FMUs by path; ``changed`` holds FMUs with other parameters."""
        return {path: self.point(path, changed.get(path, block), xp, z) for path, block in self.blocks.items()}

    def drift(self, points: Mapping[str, Any], changed: Mapping[str, Fmu]) -> dict[str, float]:
        """Return how far the outputs of FMUs without listed states move with held inputs, by the outputs' names."""
        return {
            f"{join(path, port)} over {WATCHED} steps": moved
            for path, block in self.blocks.items()
            if not block.description.states
            for port, moved in output_drift(changed.get(path, block), points[path], self.h).items()
        }

    def find_unmoved(
        self,
        xp: np.ndarray,
        z: np.ndarray,
        residuals: Mapping[str, float],
        changed: Mapping[str, Fmu],
        tolerance: float,
    ) -> list[str]:
        """Return the paths of FMUs because of which a search has ended: they list no states, and hide a memory.

        Their outputs are off in the equations, and move with held inputs, or follow no input within a step.
        """
        found, points = [], self.points(xp, z, changed)
        for path, block in self.blocks.items():
            mine = plant_entries(self.flat, path)[1]
            off = [i for i in mine if not residuals.get(self.flat.plant_outputs.labels[i], 0.0) <= tolerance]
            if block.description.states or not off:
                continue
            now = changed.get(path, block)
            with suppress(FmuError):  # the residuals alone are said of an FMU that can't be run on from there
                model, _ = self._evaluate_one(path, now, xp, z)
                moved = output_drift(now, points[path], self.h)
                if not max(moved.values()) <= tolerance or not model.D.any():
                    found.append(path)
        return found

    def change_blocks(self, free: list[Free], q: list[np.ndarray]) -> dict[str, Fmu]:
        """Return the FMUs with free parameters, with these values of them, by path."""
        found: dict[str, Fmu] = {}
        for f, value in zip(free, q, strict=True):
            if f.path in self.blocks:
                found[f.path] = change_parameter(found.get(f.path, self.blocks[f.path]), f.keys, f.shape_value(value))
        return found

    def evaluate(self, xp: np.ndarray, z: np.ndarray, free: list[Free], q: list[np.ndarray]) -> PlantValues:
        """Evaluate all FMUs; the derivatives by their parameters are differences.

        At rest a dead time puts out its input; else it puts out what it does where the search begins.
        """
        flat, n = self.flat, self.total
        nw = flat.plant_outputs.total
        f, y, models = np.zeros(n), np.zeros(nw), list[PlantModel]()
        changed = self.change_blocks(free, q)
        for path, own in self.own.items():
            m, f[own] = self._evaluate_one(path, changed.get(path, self.blocks[path]), xp, z)
            m = replace(m, A=m.A - np.eye(len(m.A))) if self.by_step[path] else m
            models.append(plant_model(flat, path, m))
            y[models[-1].outputs] = m.y0
        A, B, C, D = (join_matrices(flat, models, which) for which in "ABCD")

        def evaluate(i: int, others: list[np.ndarray]) -> list[np.ndarray]:
            path, rates, outputs = free[i].path, np.zeros(n), np.zeros(nw)
            m, rates[self.own[path]] = self._evaluate_one(path, self.change_blocks(free, others)[path], xp, z)
            outputs[plant_entries(flat, path)[1]] = m.y0
            return [rates, outputs]

        chosen = [i for i, parameter in enumerate(free) if parameter.path in self.blocks]
        f_by_q, y_by_q = differentiate_by(free, q, chosen, (n, nw), evaluate)
        inputs, outputs = self.delays.inputs, self.delays.outputs
        y[outputs] = z[inputs] if self.rest else self.at_start.w[outputs]
        D[outputs, inputs] = float(self.rest)
        return PlantValues(f, y, A, B, C, D, f_by_q, y_by_q)

    def _evaluate_one(
        self, path: str, block: Fmu, xp: np.ndarray, z: np.ndarray
    ) -> tuple[FmuLinearization, np.ndarray]:
        """Return an FMU's linear model, and f: rates, or changes over a step."""
        m = self._linearize(block, self.point(path, block, xp, z), step=self.by_step[path])
        return m, m.f - m.x0 if self.by_step[path] else m.f


class ExchangedPlants:
    """FMUs in model exchange whose start values are free: evaluators of the FMUs with other values, and differences."""

    def __init__(self, diagram: WiredDiagram, flat: FlatDiagram, at: OperatingPoint, free: list[Free]):
        self.diagram, self.at_start, self.free = diagram, at, free
        self.mine = [i for i, f in enumerate(free) if f.block.in_model_exchange]
        self.as_they_are = evaluators_at(flat, at)

    def evaluators(self, q: Sequence[np.ndarray]) -> Evaluators | None:
        """Return evaluators of the FMUs with values of the free parameters."""
        if not self.mine:
            return self.as_they_are
        values = {self.free[i].name: self.free[i].shape_value(q[i]) for i in self.mine}
        return load_evaluators(self.diagram.replace(values).flatten_like(self.at_start), self.at_start)

    def differentiate(
        self,
        q: Sequence[np.ndarray],
        values: Sequence[np.ndarray],
        evaluate: Callable[[Evaluators | None], Sequence[np.ndarray]],
    ) -> list[np.ndarray]:
        """Return the derivatives of vectors by all free parameters: differences, zeros of those of other blocks."""
        sizes = [v.size for v in values]
        return differentiate_by(self.free, q, self.mine, sizes, lambda _, others: evaluate(self.evaluators(others)))


def differentiate_by(
    free: Sequence[Free],
    q: Sequence[np.ndarray],
    chosen: Iterable[int],
    sizes: Sequence[int],
    evaluate: Callable[[int, list[np.ndarray]], Sequence[np.ndarray]],
) -> list[np.ndarray]:
    """Return the derivatives of vectors by all free parameters: central differences by those that are chosen, or zeros.

    ``chosen`` are the numbers of those that the vectors may follow, ``sizes`` the vectors' sizes. ``evaluate`` leads
    from the number of a parameter, and the values with another one of it, to the vectors.
    """
    columns = [np.zeros((size, sum(value.size for value in q))) for size in sizes]
    first = np.cumsum([0, *(value.size for value in q)])
    for i in chosen:
        for j in range(q[i].size):
            size = max(abs(float(q[i][j])), abs(float(free[i].start[j])) or 1.0)  # a search may come by 0
            sides, width = free[i].find_sides(q[i], j, RELATIVE_STEP * size)
            if width:  # a parameter with one value only stays
                ends = (evaluate(i, [*q[:i], value, *q[i + 1 :]]) for value in sides)
                high, low = ([np.ravel(v).copy() for v in values] for values in ends)
                for column, above, below in zip(columns, high, low, strict=True):
                    column[:, first[i] + j] = (above - below) / width
    return columns


RUN_INSTEAD = (
    "Run there instead: once a run has settled, diagram.operating_point(t) is its point, and linearize(t) and at=t "
    "take it; or export the FMU with its derivatives listed."
)
"""The next step where an FMU lists no states."""


def check_drift(drift: Mapping[str, float], tolerance: float, name: str, t: float) -> None:
    """Refuse a point at which an FMU that lists no states moves: nothing in the equations could let it rest."""
    moved = {port: value for port, value in drift.items() if not value <= tolerance}
    if moved:
        shown = "; ".join(f"{port}: {value:.3g}" for port, value in moved.items())
        raise SimulationError(
            "no operating point was found: an FMU lists no states in its description, so a trim can't let them rest, "
            f"and with its inputs held its outputs move, relative to 1 + their size, by {shown}; expected at most "
            f"{tolerance:g}. {RUN_INSTEAD}",
            block=name,
            t=t,
        )
