"""Linear models of the FMUs of a diagram: of their equations or of their steps, as their descriptions allow.

`linearize_plant` gives that of one plant's equations, which may be a block, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from ...blocks.core import Block, FmuError, Layout, LoopwrightError, OptionError, ParameterError, kinds
from ...fmus.fmu_block import Derivation, FmuLinearization, linearize_fmu, step_gap
from ...fmus.platform import is_built_here
from ..flat import FlatDiagram, StateLayout, WiredDiagram
from ..frequency import hold_inputs
from ..results import OperatingPoint
from ..wiring import join, stepped_blocks
from .block_slopes import linearize_block
from .exchanged import fmu_at, linearize_exchanged
from .identification import identify_step

if TYPE_CHECKING:
    from ...fmus.fmu_block import Fmu

A_WAY = kinds.one_of("equations", "step", "identified").worded(
    "one of 'equations', 'step', 'identified', or None", found=kinds.by_name
)
"""Methods for the linear model of an FMU's step."""
SOLVED, COARSE = 1e-9, 1e-5
"""Distances of an FMU's step from its equations: up to which they are one, and beyond which the step is the model."""
EQUILIBRIUM = 1e-9
"""Largest residual of an equilibrium: of a rate in 1/s, or a change over a step, relative to 1 + its state's size."""


@dataclass(frozen=True, eq=False)
class PlantModel:
    """A linear model of one FMU: of its equations, or of one communication step.

    x_p⁺ (or dx_p/dt) = f + A (x_p − x0) + B (z − z0). The outputs at the instant are w = C x_p + D z, with the inputs
    that have acted until then. ``inputs`` and ``outputs`` are the numbers of the FMU's entries in z and w.
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
    """Largest error of an entry, of those that are known."""
    y_next: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """Outputs after the step."""
    next: Mapping[str, Any] = field(default_factory=dict)
    """Operating point of the FMU after the step."""
    identified: bool = False
    """Whether the states are those of an identified model, not the FMU's."""
    after: tuple[np.ndarray, np.ndarray] | None = None
    """Derivatives of the outputs after a step by x_p and z before it; None where C and D are those there, too."""

    @property
    def y_by_states(self) -> np.ndarray:
        """Derivative of the outputs after a step by x_p before it."""
        return self.C @ self.A if self.after is None else self.after[0]

    @property
    def y_by_inputs(self) -> np.ndarray:
        """Derivative of the outputs after a step by z."""
        return self.C @ self.B + self.D if self.after is None else self.after[1]


def plant_paths(flat: FlatDiagram) -> list[str]:
    """Return the paths of the FMUs."""
    return list(stepped_blocks(flat.table))


def plant_layout(blocks: Mapping[str, Block], points: Mapping[str, Any], offset: int = 0) -> StateLayout:
    """Return the layout of the FMUs' states, one FMU after the other by path, from an operating point's ``plants``."""
    shapes = {
        path: {n: np.shape(points[path]["state"][n]) for n in cast("Fmu", blocks[path]).description.states}
        for path in sorted(points)
    }
    return StateLayout.of_blocks(shapes, offset)


def plant_entries(flat: FlatDiagram, path: str) -> tuple[list[int], list[int], list[int]]:
    """Return the numbers of an FMU's entries in z and in w, and those of its wired inputs among all its inputs."""
    block = flat.table.blocks[path]
    inputs = Layout.of({port: spec.shape or () for port, spec in block.inputs.items()})
    wired = [port for port in block.inputs if join(path, port) in flat.plant_inputs.slices]
    z = flat.plant_inputs.entries(join(path, port) for port in wired)
    w = flat.plant_outputs.entries(join(path, port) for port in block.outputs)
    return z, w, inputs.entries(wired)


def inputs_before(flat: FlatDiagram, at: OperatingPoint) -> np.ndarray:
    """Return the inputs z that have acted until the operating point."""
    every = [value for path in plant_paths(flat) for value in at.plants[path]["inputs"].values()]
    z = np.zeros(flat.plant_inputs.total, dtype=complex if any(map(np.iscomplexobj, every)) else float)
    for path in plant_paths(flat):
        for port, value in at.plants[path]["inputs"].items():
            where = flat.plant_inputs.slices.get(join(path, port))
            if where is not None:
                z[where] = np.ravel(value)
    return z


def join_matrices(flat: FlatDiagram, models: Sequence[PlantModel], which: str) -> np.ndarray:
    """Return the matrix A, B, C or D of all FMUs, with rows and columns in the order of x_p, z and w."""
    states = Layout.of({m.path: (len(m.A),) for m in models})
    many = {"x": states.total, "z": flat.plant_inputs.total, "w": flat.plant_outputs.total}
    row_of, column_of = {"A": ("x", "x"), "B": ("x", "z"), "C": ("w", "x"), "D": ("w", "z")}[which]
    M = np.zeros((many[row_of], many[column_of]), dtype=np.result_type(float, *(m.A for m in models)))
    for m in models:
        own = {"x": states.entries([m.path]), "z": m.inputs, "w": m.outputs}
        M[np.ix_(own[row_of], own[column_of])] = {"A": m.A, "B": m.B, "C": m.C, "D": m.D}[which]
    return M


def states_of(models: Sequence[PlantModel]) -> list[str]:
    """Return the names of the states of all FMUs."""
    return [name for m in models for name in m.states]


def plant_changes(flat: FlatDiagram, at: OperatingPoint) -> dict[str, np.ndarray]:
    """Return the change of the FMUs' states in one second, relative to 1 + their size, by the states' names.

    It is the change over a step if an FMU does not give its rates. States that an FMU does not show are left out.
    """
    found: dict[str, np.ndarray] = {}
    for path in plant_paths(flat):
        block = fmu_at(flat, path)
        if not block.description.states:
            continue
        now = plant_point(flat, at, path, at.z)
        try:
            m = linearize_fmu(block, **now)
            change = m.f
        except LoopwrightError:
            try:
                m = linearize_fmu(block, h=float(flat.base), **now)
            except LoopwrightError:
                continue
            change = m.f - m.x0
        size = np.abs(change) / (1.0 + np.abs(m.x0))
        found |= {f"{path}.{name}": size[i : i + 1] for i, name in enumerate(m.states)}
    return found


def model_equations(flat: FlatDiagram, at: OperatingPoint, way: str | None) -> list[PlantModel]:
    """Return the linear models of the equations of all FMUs."""
    if way == "step" and plant_paths(flat):
        raise OptionError(
            'found plants="step" for a continuous model, which has no step; expected None, "equations" or a step. Give '
            "the communication step: linearize(…, step=…).",
            block=plant_paths(flat)[0],
            port="plants",
        )
    return [plant_model(flat, path, linearize_equations(flat, at, path, at.z)) for path in plant_paths(flat)]


def plant_model(flat: FlatDiagram, path: str, m: FmuLinearization, **more: Any) -> PlantModel:
    """Return a linear model of an FMU by its entries in z and w, of those inputs alone that are wired."""
    z, w, wired = plant_entries(flat, path)
    return PlantModel(
        path=path,
        A=m.A,
        B=m.B[:, wired],
        C=m.C,
        D=m.D[:, wired],
        x0=m.x0,
        f=m.f,
        states=_prefix_names(path, m.states),
        inputs=z,
        outputs=w,
        derivation=m.derivation,
        uncertainty=_largest_error(m),
        **more,
    )


def model_step(
    flat: FlatDiagram, at: OperatingPoint, path: str, z: np.ndarray, h: float, way: str | None
) -> PlantModel:
    """Return the linear model of one communication step of an FMU.

    ``z`` are the inputs of all FMUs over the step, h its length in s. As to the ``way``: "equations" takes the matrix
    exponential of the equations' Jacobians under held inputs, which is exact at an equilibrium; "step" differences the
    step itself; "identified" takes pulse responses from rest. None takes the first at an equilibrium, else the second;
    where the FMU does not allow that, the first with its error, or the third.
    """
    block, now = fmu_at(flat, path), plant_point(flat, at, path, z)
    equations: FmuLinearization | None
    try:
        equations = linearize_fmu(block, **now)
    except FmuError:
        if way == "equations":
            raise
        equations = None
    rests = equations is not None and (way == "equations" or (way is None and _is_at_rest(equations)))
    m = _hold_at_rest(block, now, h, way, equations) if equations is not None and rests else None
    after = None
    if m is None:
        if way == "identified" or not block.description.states:  # the FMU may have states that it doesn't show
            return _identify_model(flat, at, path, z, h)
        try:
            step = linearize_fmu(block, h=h, **now)
        except FmuError as error:
            if way == "step":
                raise
            if equations is None:
                try:
                    return _identify_model(flat, at, path, z, h)
                except FmuError as last:
                    raise last from error
            m = _hold_in_motion(block, now, h, equations)
        else:
            C, D = _outputs_before(flat, at, path, equations, step, z)
            # the step's own derivatives are those of the outputs after it, by the states before it
            m, after = replace(step, C=C, D=D), (step.C, step.D[:, plant_entries(flat, path)[2]])
    following = {**now, "t": now["t"] + h, "state": _states_after(block, now, m.f)}
    return plant_model(flat, path, m, y_next=m.y0, next=following, after=after)


def _identify_model(flat: FlatDiagram, at: OperatingPoint, path: str, z: np.ndarray, h: float) -> PlantModel:
    mine, w, wired = plant_entries(flat, path)
    now = plant_point(flat, at, path, z)
    m = identify_step(fmu_at(flat, path), now, h, at.w[w])
    return PlantModel(
        path=path,
        A=m.A,
        B=m.B[:, wired],
        C=m.C,
        D=np.zeros((len(w), len(wired))),
        x0=np.zeros(len(m.A)),
        f=np.zeros(len(m.A)),
        states=_prefix_names(path, m.states),
        inputs=mine,
        outputs=w,
        derivation=m.derivation,
        uncertainty=m.uncertainty,
        y_next=m.y0,
        next={**now, "t": now["t"] + h},
        identified=True,
    )


def _is_at_rest(m: FmuLinearization) -> bool:
    return bool(np.max(np.abs(m.f) / (1.0 + np.abs(m.x0)), initial=0.0) <= EQUILIBRIUM)


def _hold_inputs(m: FmuLinearization, h: float) -> FmuLinearization:
    """Return the model of a step with held inputs; the rates f at the point act like a further input.

    C and D stay those at the beginning of the step, y0 are the outputs after it.
    """
    A, forced = hold_inputs(m.A, np.hstack([m.B, m.f[:, None]]), h)
    change = forced[:, -1]
    return replace(
        m,
        A=A,
        B=forced[:, :-1],
        h=h,
        f=m.x0 + change,
        y0=m.y0 + m.C @ change,
        derivation=replace(m.derivation, held=True),
        uncertainty=m.uncertainty * h,
    )


def _hold_at_rest(
    block: Fmu, now: Mapping[str, Any], h: float, way: str | None, m: FmuLinearization
) -> FmuLinearization | None:
    """Return the model of a step from the equations, with its distance to the FMU's own step.

    None where that step is another model: an FMU's own solver may be coarse, and a step of Euler's method is no matrix
    exponential.
    """
    held = _hold_inputs(m, h)
    if way is not None or is_built_here(block.description.digest):
        return held
    try:
        gap, error = step_gap(block, h=h, A=held.A, B=held.B, **now)
    except FmuError:
        return held
    if gap <= 3.0 * error + SOLVED:
        return held
    settable = all(block.description.find(name).initial == "exact" for name in block.description.states)
    if gap > max(COARSE, 10.0 * error) and settable:
        return None
    return replace(
        held, uncertainty=held.uncertainty + gap * max(np.abs(held.A).max(), np.abs(held.B).max(initial=0.0))
    )


def _hold_in_motion(block: Fmu, now: Mapping[str, Any], h: float, m: FmuLinearization) -> FmuLinearization:
    """Return the model of a step with held inputs from the equations, at a point that moves.

    The distance to such a model from the equations at the end of the step is its uncertainty.
    """
    held = _hold_inputs(m, h)
    later = linearize_fmu(block, **{**now, "t": now["t"] + h, "state": _states_after(block, now, held.f)})
    end = _hold_inputs(later, h)
    apart = max(float(np.max(np.abs(getattr(held, M) - getattr(end, M)), initial=0.0)) for M in "ABCD")
    return replace(held, uncertainty=held.uncertainty + apart)


def _outputs_before(
    flat: FlatDiagram,
    at: OperatingPoint,
    path: str,
    equations: FmuLinearization | None,
    step: FmuLinearization,
    z: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of the outputs at the beginning of a step, by the states and by the inputs until then."""
    if equations is not None:
        before = inputs_before(flat, at)
        mine = plant_entries(flat, path)[0]
        m = equations if np.array_equal(before[mine], z[mine]) else linearize_equations(flat, at, path, before)
        return m.C, m.D
    C = np.linalg.lstsq(step.A.T, step.C.T, rcond=None)[0].T  # step.C is by the states before the step: step.C = C A
    D = step.D - C @ step.B
    D[np.abs(D) <= 1e-9 * (np.max(np.abs(step.D), initial=0.0) + 1e-300)] = 0.0
    return C, D


def linearize_equations(flat: FlatDiagram, at: OperatingPoint, path: str, z: np.ndarray) -> FmuLinearization:
    """Return the linear model of an FMU's equations under the inputs z."""
    return linearize_fmu(fmu_at(flat, path), **plant_point(flat, at, path, z))


def plant_point(flat: FlatDiagram, at: OperatingPoint, path: str, z: np.ndarray) -> dict[str, Any]:
    """Return time, states and inputs of an FMU at a point: wired inputs from z, the others from the point."""
    given = dict(at.plants[path]["inputs"])
    for port in flat.table.blocks[path].inputs:
        where = flat.plant_inputs.slices.get(join(path, port))
        if where is not None:
            given[port] = z[where].reshape(np.shape(given[port]))
    return {**at.plants[path], "inputs": given}


def _states_after(block: Fmu, now: Mapping[str, Any], f: np.ndarray) -> dict[str, Any]:
    """Return an FMU's states after a step; discrete states stay as they are."""
    continuous = plant_layout({"": block}, {"": now}).of_block[""].split(f)
    return {**now["state"], **continuous}


def _prefix_names(path: str, states: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"{path}.{name}" for name in states)


def _largest_error(m: FmuLinearization) -> float:
    """Return the largest error that is known; entries with a NaN have none."""
    return float(np.max(m.uncertainty, initial=0.0, where=np.isfinite(m.uncertainty)))


# --- one plant, of its equations -------------------------------------------------------------------------------------


class PlantEquations(NamedTuple):
    """Linear model of a plant's equations, dx/dt = f + A x + B u and y = C x + D u, about an operating point.

    ``inputs`` and ``outputs`` lay out u and y by ports, ``states`` names the entries of x, and ``error`` bounds the
    errors of the entries of [[A, B], [C, D]]; it is an estimate where they are differences.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    f: np.ndarray
    x0: np.ndarray
    states: tuple[str, ...]
    inputs: Layout
    outputs: Layout
    derivation: Derivation
    error: np.ndarray


def linearize_plant(diagram: WiredDiagram, at: OperatingPoint, path: str) -> PlantEquations:
    """Return the linear model of the equations of one block or FMU of a diagram."""
    flat, block = diagram.flatten_like(at), diagram.blocks[path]
    trace = flat.checked.traced.get(path)
    if block.in_model_exchange:
        m = linearize_exchanged(flat, at, path)
    elif block.stepped:
        m = linearize_equations(flat, at, path, at.z)
    else:
        m = _linearize_block(diagram, flat, at, path)
    if trace is None:  # an FMU that is stepped declares all shapes
        shapes = [{port: spec.shape or () for port, spec in ports.items()} for ports in (block.inputs, block.outputs)]
    else:
        shapes = [dict(trace.inputs), dict(trace.outputs)]
    inputs, outputs = map(Layout.of, shapes)
    names = tuple(f"{path}.{name}" for name in m.states)
    return PlantEquations(m.A, m.B, m.C, m.D, m.f, m.x0, names, inputs, outputs, m.derivation, m.uncertainty)


def _linearize_block(diagram: WiredDiagram, flat: FlatDiagram, at: OperatingPoint, path: str) -> FmuLinearization:
    """Return the linear model of a block with the states and inputs of a point."""
    block, trace = diagram.blocks[path], diagram.checked.traced[path]
    where = flat.states.slices.get(path, slice(0, 0))
    if trace.foreign is not None or trace.advance != "derivative" or where.stop == where.start:
        raise ParameterError(
            f"found {type(block).__name__}, whose equations have no derivatives in continuous time; expected a plant "
            "with a linear model. Give an FMU, or a block with a derivative.",
            block=path,
        )
    parts = [np.zeros(0)]
    for port in trace.inputs:
        wire = diagram.structure.wires.get((path, port))
        value = block.inputs[port].default if wire is None else at.values[join(wire.block, wire.port)]
        value = np.asarray(0.0 if value is None else value, dtype=float)
        value = value if wire is None or wire.index is None else value[wire.index]
        parts.append(np.broadcast_to(value, trace.inputs[port]).ravel())
    return linearize_block(block, trace, at.t, at.x[where], np.concatenate(parts))
