"""FMUs in a trim: what their states and outputs answer to, by their linear models."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import FmuError, elements
from ..flat import FlatDiagram, WiredDiagram
from ..results import OperatingPoint
from ..wiring import join
from .plant_models import entries, plant_layout

if TYPE_CHECKING:
    from .trim_request import Free


@dataclass(eq=False)
class PlantValues:
    """f (rates, or changes over a step) and outputs y of all FMUs, and their derivatives by states, z, parameters."""

    f: np.ndarray
    y: np.ndarray
    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    f_by_q: np.ndarray
    y_by_q: np.ndarray


class Plants:
    """All FMUs of a diagram, their states one after the other."""

    def __init__(self, flat: FlatDiagram, at: OperatingPoint, diagram: WiredDiagram):
        self.flat, self.at_start, self.h = flat, at, float(flat.base)
        self.blocks: dict[str, Any] = {path: diagram.blocks[path] for path in sorted(at.plants)}
        self.states = plant_layout(self.blocks, at.plants)
        self.own = self.states.slices
        self.by_step = {path: self._needs_step(path) for path in self.blocks}
        self.x0 = np.zeros(self.states.total)
        for path, layout in self.states.of_block.items():
            for name, where in layout.slices.items():
                self.x0[where] = np.ravel(at.plants[path]["state"][name])

    @property
    def equations(self) -> list[str]:
        """Names of the equations of their states: of rates, or of changes over a step."""
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
        """For every state, the time in which f is its change: 1 s for a rate, or a step."""
        found = np.ones(self.total)
        for path, where in self.own.items():
            found[where] = self.h if self.by_step[path] else 1.0
        return found

    def _needs_step(self, path: str) -> bool:
        try:
            self._model(path, self.blocks[path], self.at_start.plants[path], step=False)
        except FmuError:
            return True
        return False

    def _model(self, path: str, block: Any, point: Mapping[str, Any], *, step: bool) -> Any:
        if step:
            return block.step_difference(self.h, t=point["t"], state=point["state"], inputs=point["inputs"])
        return block.linear_model(t=point["t"], state=point["state"], inputs=point["inputs"])

    def point(self, path: str, block: Any, xp: np.ndarray, z: np.ndarray) -> dict[str, Any]:
        """Return time, states and inputs of an FMU, as its linear models take them."""
        start, flat = self.at_start.plants[path], self.flat
        state, inputs = {**start["state"], **self.states.of_block[path].split(xp)}, dict(start["inputs"])
        back = {new: old for old, new in block.rename.items()}
        for port in block.inputs:
            where = flat.plant_inputs.slices.get(join(path, port))
            if where is not None:
                inputs[port] = z[where].reshape(np.shape(inputs[port]))
            elif back.get(port, port) in block.start:
                inputs[port] = np.reshape(block.start[back.get(port, port)], np.shape(inputs[port]))
        return {"t": start["t"], "state": state, "inputs": inputs}

    def points(self, xp: np.ndarray, z: np.ndarray, q: Mapping[str, Any]) -> dict[str, Any]:
        """Return the operating points of all FMUs, those with changed parameters as in ``q``."""
        return {path: self.point(path, q.get(path, block), xp, z) for path, block in self.blocks.items()}

    def changed(self, free: list[Free], q: list[np.ndarray]) -> dict[str, Any]:
        """Return the FMUs whose parameters are free, with these values."""
        from ..wiring import change_parameter

        found: dict[str, Any] = {}
        for f, value in zip(free, q, strict=True):
            if f.path in self.blocks:
                found[f.path] = change_parameter(found.get(f.path, self.blocks[f.path]), f.keys, f.shaped(value))
        return found

    def at(self, xp: np.ndarray, z: np.ndarray, free: list[Free], q: list[np.ndarray]) -> PlantValues:
        """Evaluate all FMUs; derivatives by their parameters are differences."""
        flat, n, many = self.flat, self.total, sum(f.start.size for f in free)
        nw, nz = flat.plant_outputs.total, flat.plant_inputs.total
        v = PlantValues(
            np.zeros(n), np.zeros(nw), np.zeros((n, n)), np.zeros((n, nz)), np.zeros((nw, n)), np.zeros((nw, nz)),
            np.zeros((n, many)), np.zeros((nw, many)),
        )  # fmt: skip
        changed = self.changed(free, q)
        for path in self.blocks:
            self._one(v, path, changed.get(path, self.blocks[path]), xp, z)
        column = 0
        for i, f in enumerate(free):
            for j in range(f.start.size):
                if f.path in self.blocks:
                    self._by_parameter(v, column, f, xp, z, free, q, i, j)
                column += 1
        return v

    def _numbers(self, path: str, block: Any, xp: np.ndarray, z: np.ndarray) -> tuple[Any, np.ndarray]:
        """Return the linear model, and f: rates, or changes over a step."""
        m = self._model(path, block, self.point(path, block, xp, z), step=self.by_step[path])
        return m, m.f - m.x0 if self.by_step[path] else m.f

    def _one(self, v: PlantValues, path: str, block: Any, xp: np.ndarray, z: np.ndarray) -> None:
        m, f = self._numbers(path, block, xp, z)
        own, (mine, w, wired) = self.own[path], entries(self.flat, path)
        v.f[own], v.y[w] = f, m.y0
        v.A[own, own] = m.A - np.eye(len(f)) if self.by_step[path] else m.A
        v.B[own, mine] = m.B[:, wired]
        v.C[w, own] = m.C
        v.D[np.ix_(w, mine)] = m.D[:, wired]

    def _by_parameter(
        self, v: PlantValues, column: int, f: Free, xp: np.ndarray, z: np.ndarray,
        free: list[Free], q: list[np.ndarray], i: int, j: int,
    ) -> None:  # fmt: skip
        d = 1e-5 * max(1.0, abs(float(q[i][j])))
        found = []
        for side in (d, -d):
            moved = [value.copy() for value in q]
            moved[i][j] += side
            m, rates = self._numbers(f.path, self.changed(free, moved)[f.path], xp, z)
            found.append((rates, m.y0))
        v.f_by_q[self.own[f.path], column] = (found[0][0] - found[1][0]) / (2 * d)
        v.y_by_q[entries(self.flat, f.path)[1], column] = (found[0][1] - found[1][1]) / (2 * d)
