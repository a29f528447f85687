"""The parts of a diagram around one plant, linear at an operating point.

The plant, an FMU or a block with equations, has a model in continuous time. The rest of a sampled diagram has one model
for each tick of its period.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...blocks.core import Block, Layout, ParameterError
from ...fmus.running import Derivation, DerivativeMethod
from ..flat import FlatDiagram, TickPattern, WiredDiagram
from ..results import OperatingPoint
from ..wiring import join
from .checks import find_moving, is_moving, replace_stairs
from .derivatives import LocalDerivatives, Tap, find_signal
from .exchanged import evaluators_at, linearize_exchanged
from .flow_model import Four
from .over_a_period import Chain, own_states, period_of
from .plant_models import linearize_equations


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
    """Return the linear model of the equations of one block or FMU of a diagram.

    Parameters
    ----------
    diagram : Diagram
        Diagram with the plant.
    at : OperatingPoint
        Instant of the diagram.
    path : str
        Path of the plant.

    Raises
    ------
    FmuError
        If the FMU gives no model of its equations.
    ParameterError
        If the block has no equations in continuous time.
    """
    flat, block = diagram.flatten_like(at), diagram.blocks[path]
    inputs, outputs = (_lay_out(block, kind) for kind in ("inputs", "outputs"))
    if block.evaluated_outside:
        return _model_exchanged(flat, at, path, inputs, outputs)
    if block.stepped:
        m = linearize_equations(flat, at, path, at.z)
        names = tuple(f"{path}.{name}" for name in m.states)
        return PlantEquations(m.A, m.B, m.C, m.D, m.f, m.x0, names, inputs, outputs, m.derivation, m.uncertainty)
    return _differentiate(diagram, flat, at, path, inputs, outputs)


def _model_exchanged(
    flat: FlatDiagram, at: OperatingPoint, path: str, inputs: Layout, outputs: Layout
) -> PlantEquations:
    """Return the model of an FMU in model exchange."""
    m = linearize_exchanged(flat, at, path)
    names = tuple(f"{path}.{name}" for name in m.states)
    return PlantEquations(m.A, m.B, m.C, m.D, m.f, m.x0, names, inputs, outputs, m.derivation, m.uncertainty)


def _lay_out(block: Block, kind: str) -> Layout:
    return Layout.of({port: spec.shape or () for port, spec in getattr(block, kind).items()})


def _differentiate(
    diagram: WiredDiagram, flat: FlatDiagram, at: OperatingPoint, path: str, inputs: Layout, outputs: Layout
) -> PlantEquations:
    """Return the model of a block, by algorithmic differentiation of its equations."""
    import casadi as ca

    block, trace = diagram.blocks[path], diagram.checked.traced[path]
    where = flat.states.slices.get(path, slice(0, 0))
    if trace.foreign is not None or trace.advance != "derivative" or where.stop == where.start:
        raise ParameterError(
            f"found {type(block).__name__}, whose equations have no derivatives in continuous time; expected a plant "
            "with a linear model. Give an FMU, or a block with a derivative.",
            block=path,
        )
    inputs, outputs = Layout.of(dict(trace.inputs)), Layout.of(dict(trace.outputs))
    u0 = np.zeros(inputs.total)
    for port in trace.inputs:
        wire = diagram.structure.wires.get((path, port))
        value = block.inputs[port].default if wire is None else at.values[join(wire.block, wire.port)]
        value = np.asarray(0.0 if value is None else value, dtype=float)
        u0[inputs.slices[port]] = np.ravel(value if wire is None or wire.index is None else value[wire.index])
    x = ca.MX.sym("x", where.stop - where.start)
    ports = [ca.MX.sym(name, int(np.prod(shape))) for name, shape in trace.inputs.items()]
    results = trace.function(at.t, x, *ports, trace.pack(block, np.inf))
    outs, rates = results[: len(trace.outputs)], results[len(trace.outputs)]
    u, values = ca.vertcat(*ports), ca.vertcat(rates, *outs)
    x0, n = at.x[where], where.stop - where.start
    function = ca.Function("linear", [x, u], [ca.jacobian(values, ca.vertcat(x, u)), values])
    J, y = (np.array(v.full()) for v in function(x0, u0))
    return PlantEquations(
        J[:n, :n], J[:n, n:], J[n:, :n], J[n:, n:], y[:n, 0], x0, tuple(flat.labels[where]), inputs, outputs,
        Derivation(DerivativeMethod.TRACED), np.zeros(J.shape),
    )  # fmt: skip


def moves_between_ticks(diagram: WiredDiagram, at: OperatingPoint, outputs: list[str], inputs: list[str]) -> str:
    """Return the name of a signal around a plant that changes between the ticks of a sampled diagram, or "".

    These are outputs of the plant that other continuous blocks follow between the ticks, and inputs of the plant that
    are not held.
    """
    flat = diagram.flatten_like(at)
    signals = [find_signal(flat, name) for name in outputs]
    local = LocalDerivatives(flat, signals, [], signals, evaluators_at(flat, at))
    sources: list[Tap] = [find_signal(flat, name) for name in inputs]
    names = [*find_moving(flat, local, at), *(s.name for s in sources if is_moving(flat, s))]
    return names[0] if names else ""


class TickModel(NamedTuple):
    """Model of the rest of a diagram from one tick to the next, with the plant's outputs injected.

    The matrices lead from the states just before the tick and the injected signals to those before the next one, and
    to the signals that are measured at the tick.

    Attributes
    ----------
    matrices : tuple of ndarray
        A, B, C and D.
    duration : float
        Time to the next tick in s.
    steps : bool
        Whether the plant exchanges signals at the tick: always, if it is no FMU.
    renews : tuple of bool
        Whether each injected wire is renewed at the tick, by the clock of its block; wires of continuous blocks and
        FMUs always are.
    """

    matrices: Four
    duration: float
    steps: bool
    renews: tuple[bool, ...]


def model_ticks(
    diagram: WiredDiagram, at: OperatingPoint, path: str, inputs: Sequence[str], outputs: Sequence[str],
    openings: Sequence[str], stairs: str | None = None,
) -> tuple[tuple[TickModel, ...], list[str]]:  # fmt: skip
    """Return the models of all ticks of a sampled diagram's period, and the names of their states.

    Parameters
    ----------
    diagram : Diagram
        Sampled diagram.
    at : OperatingPoint
        Instant at whose tick the period begins.
    path : str
        Path of the plant.
    inputs, outputs, openings : sequence of str
        Wires at which signals are injected and measured, and wires that are cut.
    stairs : str, optional
        Treatment of stairs, as `linearize` takes it.
    """
    flat = diagram.flatten_like(at)
    injected, measured, cut = ([find_signal(flat, name) for name in names] for names in (inputs, outputs, openings))
    means = replace_stairs(diagram, flat, at, stairs)
    local = LocalDerivatives(flat, injected, measured, cut, evaluators_at(flat, at), means)
    period = period_of(flat)
    chain = Chain(flat, local, at, None, period)
    chain.go_on()
    plants = range(flat.width, flat.width + chain.n_p)
    keep = _find_needed(chain.steps, own_states(flat) | set(plants))
    clocks = [_clock_of(flat, tap) for tap in injected]
    mine = flat.plant_ticks.get(path)
    found = []
    for (k, following), (A, B, C, D) in zip(chain.ticks, chain.steps, strict=True):
        found.append(TickModel(
            (A[np.ix_(keep, keep)], B[keep], C[:, keep], D),
            float(flat.base * (following - k)),
            mine is None or any(clock.acts(k) for clock in mine),
            tuple(clock is None or clock.acts(k) for clock in clocks),
        ))  # fmt: skip
    labels = chain.labels
    return tuple(found), [labels[i] for i in keep]


def _clock_of(flat: FlatDiagram, tap: Tap) -> TickPattern | None:
    """Return the clock of the subsystem that a wire comes from; None of one in continuous time."""
    subsystem = flat.table.subsystem_of.get(tap.port[0], "")
    return flat.clocks.get(subsystem) if flat.table.is_sampled(subsystem) else None


def _find_needed(steps: Sequence[Four], own: set[int]) -> list[int]:
    """Return the numbers of the own states, and of those of the others that act on anything at a tick.

    A state that stays constant, whatever the others do, acts on nothing.
    """
    acts = np.sum([np.abs(A) for A, *_ in steps], axis=0)
    shown = np.any([np.any(C, axis=0) for _, _, C, _ in steps], axis=0)
    still = np.all([np.all(np.eye(len(A)) == A, axis=1) & ~np.any(B, axis=1) for A, B, *_ in steps], axis=0)
    keep = [j for j in range(len(acts)) if j in own or not still[j]]
    while True:
        gone = [j for j in keep if j not in own and not shown[j] and not np.any(acts[[i for i in keep if i != j], j])]
        if not gone:
            return keep
        keep = [j for j in keep if j not in gone]
