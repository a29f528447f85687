"""Linear models of the FMUs of a diagram, as their descriptions allow, and how they were had."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ...blocks.core import FmuError, Layout, LoopwrightError, OptionError
from ...fmus.running import Derivation
from ..flat import FlatDiagram, StateLayout
from ..results import OperatingPoint
from ..wiring import join, stepped_blocks
from .identification import identified

WAYS = ("equations", "step", "identified")
EQUILIBRIUM = 1e-9
"""An FMU is at rest where no state changes faster than that in a second, relative to 1 + its size."""


@dataclass(frozen=True, eq=False)
class PlantModel:
    """A linear model of one FMU: of its equations, or of one communication step.

    x_p⁺ (or dx_p/dt) = f + A (x_p − x0) + B (z − z0), and its outputs at the instant w = C x_p + D z, with the inputs
    that have acted until then. ``inputs`` and ``outputs`` are the entries of z and w that are its own.
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
    derivation: Derivation
    uncertainty: float
    y_next: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Its outputs after the step."""
    next: Mapping[str, Any] = field(default_factory=dict)
    """Its operating point after the step."""
    identified: bool = False
    """Whether its states are made up, and only its outputs mean something."""


def plants(flat: FlatDiagram) -> list[str]:
    """Return the paths of the FMUs."""
    return list(stepped_blocks(flat.table))


def plant_layout(blocks: Mapping[str, Any], points: Mapping[str, Any], offset: int = 0) -> StateLayout:
    """Return where the states of FMUs stand, one FMU after the other by path, from an operating point's ``plants``."""
    states = {path: points[path]["state"] for path in sorted(points)}
    shapes = {path: {n: np.shape(state[n]) for n in blocks[path].description.states} for path, state in states.items()}
    return StateLayout.of_blocks(shapes, offset)


def entries(flat: FlatDiagram, path: str) -> tuple[list[int], list[int], list[int]]:
    """Return the entries of z and w that are an FMU's own, and the columns of its own inputs that are wired."""
    block: Any = flat.table.blocks[path]
    inputs = Layout.of({port: spec.shape or () for port, spec in block.inputs.items()})
    wired = [port for port in block.inputs if join(path, port) in flat.plant_inputs.slices]
    z = flat.plant_inputs.entries(join(path, port) for port in wired)
    w = flat.plant_outputs.entries(join(path, port) for port in block.outputs)
    return z, w, inputs.entries(wired)


def inputs_before(flat: FlatDiagram, at: OperatingPoint) -> np.ndarray:
    """Return z as it has acted until the operating point."""
    z = np.zeros(flat.plant_inputs.total)
    for path in plants(flat):
        for port, value in at.plants[path]["inputs"].items():
            where = flat.plant_inputs.slices.get(join(path, port))
            if where is not None:
                z[where] = np.ravel(value)
    return z


def joined(flat: FlatDiagram, models: Sequence[PlantModel], which: str) -> np.ndarray:
    """Return one matrix of all FMUs side by side: rows and columns as x_p, z and w are ordered."""
    states = Layout.of({m.path: (len(m.A),) for m in models})
    many = {"x": states.total, "z": flat.plant_inputs.total, "w": flat.plant_outputs.total}
    row_of, column_of = {"A": ("x", "x"), "B": ("x", "z"), "C": ("w", "x"), "D": ("w", "z")}[which]
    M = np.zeros((many[row_of], many[column_of]))
    for m in models:
        own = {"x": states.entries([m.path]), "z": m.inputs, "w": m.outputs}
        M[np.ix_(own[row_of], own[column_of])] = getattr(m, which)
    return M


def states_of(models: Sequence[PlantModel]) -> list[str]:
    """Return the names of the states of all FMUs."""
    return [name for m in models for name in m.states]


def plant_changes(flat: FlatDiagram, at: OperatingPoint) -> dict[str, np.ndarray]:
    """Return how fast the states of the FMUs change, relative to 1 + their size, by the states' names.

    In one second, or over a step where the rates are not to be had; states that an FMU does not show don't count.
    """
    found: dict[str, np.ndarray] = {}
    for path in plants(flat):
        block: Any = flat.table.blocks[path]
        if not block.description.states:
            continue
        now = {**at.plants[path], "inputs": _inputs(flat, at, path, at.z)}
        try:
            m = block.linear_model(**now)
            change = m.f
        except LoopwrightError:
            try:
                m = block.step_difference(float(flat.base), **now)
            except LoopwrightError:
                continue
            change = m.f - m.x0
        size = np.abs(change) / (1.0 + np.abs(m.x0))
        found |= {f"{path}.{name}": size[i : i + 1] for i, name in enumerate(m.states)}
    return found


def continuous_models(flat: FlatDiagram, at: OperatingPoint, way: str | None) -> list[PlantModel]:
    """Return the linear models of the equations of all FMUs.

    Raises
    ------
    OptionError
        If the model of a step is asked for: there is none.
    """
    _check_way(way)
    if way == "step" and plants(flat):
        raise OptionError(
            'found plants="step"; this model is continuous, so there is no step. Leave it away, or give the '
            "communication step: linearize(…, step=…).",
            block=plants(flat)[0],
            port="plants",
        )
    models = []
    for path in plants(flat):
        z, w, wired = entries(flat, path)
        m = _of_equations(flat, at, path, at.z)
        B, D, names = m.B[:, wired], m.D[:, wired], _named(path, m.states)
        models.append(PlantModel(path, m.A, B, m.C, D, m.x0, m.f, names, z, w, m.derivation, _error(m)))
    return models


def step_models(flat: FlatDiagram, at: OperatingPoint, z: np.ndarray, h: float, way: str | None) -> list[PlantModel]:
    """Return the linear models of one communication step of all FMUs.

    Parameters
    ----------
    z : ndarray
        Inputs of all FMUs over the step.
    way : {None, "equations", "step", "identified"}
        "equations" takes the zero-order hold of the equations' Jacobians, by a matrix exponential, which is right at an
        equilibrium; "step" differences the step itself; "identified" takes pulse responses from rest. None takes the
        first at an equilibrium, else the second, and the third where the FMU allows neither.

    Raises
    ------
    OptionError
        Another way.
    FmuError
        An FMU that allows neither.
    """
    _check_way(way)
    return [_step_model(flat, at, path, z, h, way) for path in plants(flat)]


def _check_way(way: str | None) -> None:
    if way not in (None, *WAYS):
        raise OptionError(f"found plants={way!r}; expected one of {', '.join(map(repr, WAYS))}, or None.")


def _step_model(
    flat: FlatDiagram, at: OperatingPoint, path: str, z: np.ndarray, h: float, way: str | None
) -> PlantModel:
    mine, w, wired = entries(flat, path)
    block: Any = flat.table.blocks[path]
    try:
        equations = _of_equations(flat, at, path, z)
    except FmuError:
        if way == "equations":
            raise
        equations = None
    if equations is not None and (way == "equations" or (way is None and _rests(equations))):
        m, derivation = _held(equations, h), replace(equations.derivation, held=True)
        C, D = equations.C, equations.D
    elif way == "identified" or not block.description.states:  # it may have states that it doesn't show
        return _identified_model(flat, at, path, z, h)
    else:
        try:
            m = block.step_difference(
                h, t=at.plants[path]["t"], state=at.plants[path]["state"], inputs=_inputs(flat, at, path, z)
            )
        except FmuError as error:
            if way == "step":
                raise
            try:
                return _identified_model(flat, at, path, z, h)
            except FmuError as last:
                raise last from error
        derivation = m.derivation
        C, D = _outputs_before(flat, at, path, equations, m, z)
    names = _named(path, m.states)
    following = {
        "t": at.plants[path]["t"] + h,
        "state": _after(block, at, path, m.f),
        "inputs": _inputs(flat, at, path, z),
    }
    return PlantModel(
        path, m.A, m.B[:, wired], C, D[:, wired], m.x0, m.f, names, mine, w, derivation, _error(m), m.y0, following
    )


def _identified_model(flat: FlatDiagram, at: OperatingPoint, path: str, z: np.ndarray, h: float) -> PlantModel:
    mine, w, wired = entries(flat, path)
    now = {**at.plants[path], "inputs": _inputs(flat, at, path, z)}
    m = identified(flat.table.blocks[path], now, h, at.w[w])
    n, rest = len(m.A), {**now, "t": now["t"] + h}
    D = np.zeros((len(w), len(wired)))
    return PlantModel(
        path, m.A, m.B[:, wired], m.C, D, np.zeros(n), np.zeros(n), _named(path, m.states), mine, w, m.derivation,
        m.uncertainty, m.y0, rest, True,
    )  # fmt: skip


def _rests(m: Any) -> bool:
    return bool(np.max(np.abs(m.f) / (1.0 + np.abs(m.x0)), initial=0.0) <= EQUILIBRIUM)


@dataclass(frozen=True, eq=False)
class _Held:
    """A model of a step, from that of the equations."""

    A: np.ndarray
    B: np.ndarray
    x0: np.ndarray
    f: np.ndarray
    y0: np.ndarray
    states: tuple[str, ...]
    uncertainty: np.ndarray


def _held(m: Any, h: float) -> _Held:
    """Hold the inputs over a step: a matrix exponential of [[A, B, f], [0, 0, 0]]."""
    from scipy.linalg import expm

    n, k = m.B.shape
    big = np.zeros((n + k + 1, n + k + 1))
    big[:n] = np.hstack([m.A, m.B, m.f[:, None]])
    whole = expm(big * h)[:n]
    moved = whole[:, -1]
    return _Held(whole[:, :n], whole[:, n:-1], m.x0, m.x0 + moved, m.y0 + m.C @ moved, m.states, m.uncertainty * h)


def _outputs_before(
    flat: FlatDiagram, at: OperatingPoint, path: str, equations: Any, step: Any, z: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of the outputs at the beginning of a step, by the states and the inputs until then."""
    if equations is not None:
        before = inputs_before(flat, at)
        mine = entries(flat, path)[0]
        m = equations if np.array_equal(before[mine], z[mine]) else _of_equations(flat, at, path, before)
        return m.C, m.D
    C = np.linalg.lstsq(step.A.T, step.C.T, rcond=None)[0].T  # of the step's end, from its beginning
    D = step.D - C @ step.B
    D[np.abs(D) <= 1e-9 * (np.max(np.abs(step.D), initial=0.0) + 1e-300)] = 0.0
    return C, D


def _of_equations(flat: FlatDiagram, at: OperatingPoint, path: str, z: np.ndarray) -> Any:
    block: Any = flat.table.blocks[path]
    return block.linear_model(t=at.plants[path]["t"], state=at.plants[path]["state"], inputs=_inputs(flat, at, path, z))


def _inputs(flat: FlatDiagram, at: OperatingPoint, path: str, z: np.ndarray) -> dict[str, Any]:
    """Return an FMU's inputs by their ports: those that are wired from z, the others as they are."""
    given = dict(at.plants[path]["inputs"])
    block: Any = flat.table.blocks[path]
    for port in block.inputs:
        where = flat.plant_inputs.slices.get(join(path, port))
        if where is not None:
            given[port] = z[where].reshape(np.shape(given[port]))
    return given


def _after(block: Any, at: OperatingPoint, path: str, f: np.ndarray) -> dict[str, Any]:
    """Return an FMU's states after a step, discrete ones as they are."""
    moved = plant_layout({path: block}, {path: at.plants[path]}).of_block[path].split(f)
    return {**at.plants[path]["state"], **moved}


def _named(path: str, states: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"{path}.{name}" for name in states)


def _error(m: Any) -> float:
    return float(np.max(m.uncertainty, initial=0.0))
