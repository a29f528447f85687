"""Linear models of the FMUs of a diagram, as their descriptions allow, and how they were had."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..blocks._errors import FmuError, OptionError
from ._flat import FlatDiagram
from ._operating_point import OperatingPoint
from ._structure import join

WAYS = ("equations", "step")
EQUILIBRIUM = 1e-9


@dataclass(frozen=True, eq=False)
class PlantModel:
    """A linear model of one FMU: of its equations, or of one communication step.

    x_p⁺ (or dx_p/dt) = f + A (x_p − x0) + B (z − z0), and its outputs at any time w = C x_p + D z, with the inputs that
    have acted until then. ``inputs`` and ``outputs`` are the entries of z and w that are its own.
    """

    path: str
    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    x0: np.ndarray
    f: np.ndarray
    states: tuple[str, ...]
    inputs: list[int]
    outputs: list[int]
    how: str
    uncertainty: float


def _plants(flat: FlatDiagram) -> list[str]:
    return [p for p in sorted(flat.table.blocks) if hasattr(flat.table.blocks[p], "instantiate")]


def _entries(flat: FlatDiagram, path: str) -> tuple[list[int], list[int], list[int]]:
    """Return the entries of z and w that are an FMU's own, and the columns of its own inputs that are wired."""
    block: Any = flat.table.blocks[path]
    z, w, wired, position = [], [], [], 0
    for port, spec in block.inputs.items():
        n = int(np.prod(spec.shape or (), dtype=int))
        where = flat.plant_inputs.slices.get(join(path, port))
        if where is not None:
            z += range(where.start, where.stop)
            wired += range(position, position + n)
        position += n
    for port in block.outputs:
        where = flat.plant_outputs.slices[join(path, port)]
        w += range(where.start, where.stop)
    return z, w, wired


def continuous_models(flat: FlatDiagram, at: OperatingPoint, way: str | None) -> list[PlantModel]:
    """Return the linear models of the equations of all FMUs."""
    models = []
    for path in _plants(flat):
        z, w, wired = _entries(flat, path)
        m = _of_equations(flat, at, path, z)
        models.append(
            PlantModel(
                path, m.A, m.B[:, wired], m.C, m.D[:, wired], m.x0, m.f, _named(path, m.states), z, w, m.how, _error(m)
            )
        )
    return models


def step_models(flat: FlatDiagram, at: OperatingPoint, h: float, way: str | None) -> list[PlantModel]:
    """Return the linear models of one communication step of all FMUs.

    Parameters
    ----------
    way : {None, "equations", "step"}
        "equations" takes the zero-order hold of the equations' Jacobians, by a matrix exponential, which is right at an
        equilibrium; "step" differences the step itself. None takes the first at an equilibrium, else the second.

    Raises
    ------
    OptionError
        Another way.
    FmuError
        An FMU that allows neither.
    """
    if way not in (None, *WAYS):
        raise OptionError(f"found plants={way!r}; expected one of {', '.join(map(repr, WAYS))}, or None.")
    return [_step_model(flat, at, path, h, way) for path in _plants(flat)]


def _step_model(flat: FlatDiagram, at: OperatingPoint, path: str, h: float, way: str | None) -> PlantModel:
    z, w, wired = _entries(flat, path)
    block: Any = flat.table.blocks[path]
    equations = None
    if way != "step":
        try:
            equations = _of_equations(flat, at, path, z)
        except FmuError:
            if way == "equations":
                raise
    rest = equations is not None and np.max(np.abs(equations.f) / (1.0 + np.abs(equations.x0)), initial=0.0) <= EQUILIBRIUM
    if equations is not None and (rest or way == "equations"):
        from scipy.linalg import expm

        n, m = equations.B.shape
        both = expm(np.block([[equations.A, equations.B], [np.zeros((m, n + m))]]) * h)
        return PlantModel(
            path,
            both[:n, :n],
            both[:n, n:][:, wired],
            equations.C,
            equations.D[:, wired],
            equations.x0,
            equations.x0 + _increment(equations, h),
            _named(path, equations.states),
            z,
            w,
            f"{equations.how}, held over a step by a matrix exponential",
            _error(equations) * h,
        )
    point = dict(at.plants[path])
    s = block.step_difference(h, t=point["t"], state=point["state"], inputs=_inputs(flat, at, path, z, point))
    C = np.linalg.solve(s.A.T, s.C.T).T
    D = s.D - C @ s.B
    D[np.abs(D) <= 1e-9 * (np.max(np.abs(s.D), initial=0.0) + 1e-300)] = 0.0
    return PlantModel(
        path, s.A, s.B[:, wired], C, D[:, wired], s.x0, s.f, _named(path, s.states), z, w, s.how, _error(s)
    )


def _increment(m: Any, h: float) -> Any:
    return h * m.f


def _of_equations(flat: FlatDiagram, at: OperatingPoint, path: str, z: list[int]) -> Any:
    block: Any = flat.table.blocks[path]
    point = dict(at.plants[path])
    return block.linear_model(t=point["t"], state=point["state"], inputs=_inputs(flat, at, path, z, point))


def _inputs(flat: FlatDiagram, at: OperatingPoint, path: str, z: list[int], point: Any) -> dict[str, Any]:
    """Return the FMU's inputs from this instant on."""
    given = dict(point["inputs"])
    block: Any = flat.table.blocks[path]
    for port in block.inputs:
        where = flat.plant_inputs.slices.get(join(path, port))
        if where is not None:
            given[port] = at.z[where].reshape(np.shape(given[port]))
    return given


def _named(path: str, states: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"{path}.{name}" for name in states)


def _error(m: Any) -> float:
    return float(np.max(m.uncertainty, initial=0.0))
