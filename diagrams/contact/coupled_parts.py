"""The parts of a diagram that an environment at its plant couples: the plant's equations, and all the rest.

The plant is one block or FMU with a force port. Its equations are linearized in continuous time. All its outputs are
opened; what then leads from them, and from the measured force, to the plant's inputs is the controller, sampled or
continuous: the rest of the diagram, with its actuators, sensors and delays.

A sampled controller is one at each tick of its period. In one rate the period is the sample time, and there is one
tick. In several rates, at each tick some subsystems act, and the others hold their outputs; an FMU exchanges signals at
its own communication points. The signals that are held are states of the controller, so that at every tick it leads
from all signals of the plant to all its inputs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks.core import (
    Finding,
    FmuError,
    OptionError,
    ParameterError,
    ShapeError,
)
from ...fmus.fmu_block import Derivation
from ..frequency import FourMatrices
from ..linearization import (
    BlockFinding,
    Linearization,
    PlantEquations,
    Tap,
    UnusualStart,
    find_signal,
    linearize,
    linearize_plant,
    model_ticks,
    moves_between_ticks,
    wire_entries,
)
from .contact_ports import Ports, check_command, check_unit, force_wire_error
from .held_signals import ControllerTick, StateMatrices, hold_signals
from .measured_force import Tool, find_entry, find_tool

if TYPE_CHECKING:
    from ..flat import FlatDiagram, WiredDiagram
    from ..results import OperatingPoint
    from ..wiring import Wire


AT_REST = 1e-9
"""Largest change of a state in one second or over a sample, relative to 1 + its size, at a point that is at rest."""
_ROUNDED = 1e-9
"""Relative size of an entry that should be zero."""
_DOUBTFUL = 10.0
"""Factor by which a stated error of differences may be too small."""


@dataclass(frozen=True, eq=False)
class ContactParts:
    """Plant and controller, linear at an operating point; n_f is the number of entries of the force."""

    plant: StateMatrices  # from the plant's wired inputs to its wired outputs, continuous
    force: np.ndarray  # input matrix of the force port, shape (n, n_f)
    force_shown: np.ndarray  # feedthrough from the force port to the wired outputs
    position: np.ndarray  # output matrix of the contact's position, shape (n_f, n)
    velocity: np.ndarray  # the same of its velocity
    # from the plant's outputs and the measured force to the plant's inputs; in several rates at the first tick
    controller: StateMatrices
    sample_time: float  # T in s, the period of several rates; 0 if everything is continuous
    is_stepped: bool  # whether the plant is an FMU, whose outputs at a tick are those under its last inputs
    tool: Tool
    derivation: Derivation
    # of the entries of `plant`, and of those of (A, force, position, velocity); zero if they are exact
    errors: tuple[StateMatrices, StateMatrices]
    findings: tuple[Finding, ...]
    # wire to which the environment's force is added; None if the controller does not measure it
    entry: str | None = None
    ticks: tuple[ControllerTick, ...] = ()  # controllers at the ticks of a period with several; empty with one
    # names of the plant's states and of the controller's; the latter are empty in several rates
    states: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())

    @property
    def tool_mass(self) -> float:
        """Mass of the tool in kg that the diagram's force sensor feels."""
        return self.tool.mass

    @property
    def controllers(self) -> tuple[ControllerTick, ...]:
        """Controllers at the ticks of a sampled loop's period."""
        return self.ticks or (ControllerTick(self.controller, self.sample_time),)

    @property
    def shortest(self) -> float:
        """Shortest time between ticks in s; 0 if everything is continuous."""
        return min(tick.duration for tick in self.controllers)


def take_apart(
    diagram: WiredDiagram, ports: Ports, measured: str | None, point: OperatingPoint, options: Mapping[str, Any]
) -> tuple[ContactParts, bool]:
    """Return the linear parts of a diagram at a point, and whether that point is a start unlike every later tick."""
    path, block = ports.plant, diagram.blocks[ports.plant]
    flat = diagram.flatten_like(point)
    wires = _find_sources(flat, path)
    used = {wire.port for wire in flat.table.wires.values() if wire.block == path}
    seen = [name for name in block.outputs if name in used]
    outputs = [f"{path}.{name}" for name in seen]
    sources = list(dict.fromkeys(f"{wire.block}.{wire.port}" for wire in wires.values()))
    signal = None if measured is None else find_signal(flat, measured)
    inside = signal is not None and signal.port[0] == path  # the plant measures the force itself
    entry = signal
    if signal is not None and not inside:
        entry = find_entry(diagram, point, ports, signal, wires, outputs, options)
    # All but the plant, from its outputs and the measured force to the sources of its inputs; and the plant alone.
    injected = outputs if entry is None or inside else [*outputs, entry.name]
    model = linearize(diagram, point, inputs=injected, outputs=sources, openings=outputs, **options)
    model.refuse_delays("a contact")
    _check_held(diagram, point, path, model, outputs, sources)
    m = _linearize_plant(diagram, point, path)
    _check_rest(path, m, model)
    felt = [] if signal is None else list(signal.entries)
    pushed, position, velocity = _find_entries(m, ports, measured, len(felt))
    wired, rows = m.inputs.entries(wires), m.outputs.entries(seen)
    # The controller at each tick. A force that the plant measures itself comes by one of its outputs.
    own = [] if not inside or signal is None else [rows.index(m.outputs.slices[signal.port[1]].start + i) for i in felt]

    def cut(matrices: FourMatrices, states: Sequence[str]) -> StateMatrices:
        K = _cut_controller(matrices, states, path, wires, flat, signal if entry is signal else None)
        if signal is None:
            return StateMatrices(K.A, _widen(K.B, len(pushed)), K.C, _widen(K.D, len(pushed)))
        return StateMatrices(K.A, np.hstack([K.B, K.B[:, own]]), K.C, np.hstack([K.D, K.D[:, own]]))

    ticks: tuple[ControllerTick, ...] = ()
    if model.dt and model.dt != float(point.base):
        models, states = model_ticks(diagram, point, path, injected, sources, outputs, options.get("stairs"))
        last = None if entry is None or inside or entry is not signal else len(injected) - 1
        ticks = hold_signals(models, lambda four: cut(four, states), len(rows), last, inside=inside)
        K = ticks[0].matrices
    else:
        K = cut((model.A, model.B, model.C, model.D), model.states)
    n, U = len(m.A), m.error
    E = StateMatrices(U[:n, :n], U[:n, n:], U[n:, :n], U[n:, n:])
    _check_contact(path, ports, m, E, (pushed, position, velocity))
    if signal is not None:  # it acts on the controller alone, and not on the force port again
        check_unit(diagram, path, ports, signal)
        check_command(flat, ports, signal, wires)
        entries = [wired.index(i) for i in pushed if i in wired]
        if any(np.any(one.matrices.D[entries, -len(felt) :]) for one in ticks or [ControllerTick(K, 0.0)]):
            raise force_wire_error(flat, ports, signal)

    def lead(names: Sequence[str]) -> Linearization:
        return linearize(diagram, point, inputs=names, outputs=sources, openings=outputs, **options)

    parts = ContactParts(
        plant=_of_ports(StateMatrices(m.A, m.B, m.C, m.D), rows, wired),
        force=m.B[:, pushed],
        force_shown=m.D[np.ix_(rows, pushed)],
        position=m.C[position],
        velocity=m.C[velocity],
        controller=K,
        sample_time=model.dt,
        is_stepped=block.stepped,
        tool=find_tool(flat, ports, m, signal, entry, lead, sampled=bool(model.dt)),
        derivation=m.derivation,
        errors=(_of_ports(E, rows, wired), StateMatrices(E.A, E.B[:, pushed], E.C[position], E.C[velocity])),
        findings=_collect_findings(model, path),
        entry=None if entry is None else entry.name,
        ticks=ticks,
        states=(tuple(m.states), () if ticks else tuple(name for name in model.states if not _is_of(path, name))),
    )
    return parts, any(isinstance(f, UnusualStart) for f in model.findings)


def _find_sources(flat: FlatDiagram, path: str) -> dict[str, Wire]:
    """Return the sources of a plant's inputs, by input; wires go through the delays of subsystems."""
    found = {
        port: wire
        for port in flat.table.blocks[path].inputs
        if (wire := flat.table.wires.get((path, port))) is not None
    }
    looped = next((port for port, wire in found.items() if wire.block == path), None)
    if looped is not None:
        raise OptionError(
            f"found it wired to an output of {path!r} itself; expected a block between them. Put a Gain(gain=1) there.",
            block=path,
            port=looped,
        )
    return found


def _find_entries(
    m: PlantEquations, ports: Ports, measured: str | None, felt: int
) -> tuple[list[int], list[int], list[int]]:
    """Return the entries of the force among the model's inputs, of position and velocity among its outputs."""
    pushed = m.inputs.entries([ports.force])
    position, velocity = (m.outputs.entries([name]) for name in (ports.position, ports.velocity))
    if not len(position) == len(velocity) == len(pushed) or felt not in (0, len(pushed)):
        raise ShapeError(
            f"found {len(pushed)} entries of the force, {len(position)} of the position, {len(velocity)} of the "
            f"velocity and {felt} of the measured force {measured!r}; expected equal numbers. Name other ports.",
            block=ports.plant,
            port=ports.force,
        )
    return pushed, position, velocity


def _of_ports(four: StateMatrices, rows: list[int], columns: list[int]) -> StateMatrices:
    """Return matrices with some of their outputs and inputs."""
    return StateMatrices(four.A, four.B[:, columns], four.C[rows], four.D[np.ix_(rows, columns)])


def _widen(M: np.ndarray, by: int) -> np.ndarray:
    return np.hstack([M, np.zeros((len(M), by))])


def _collect_findings(model: Linearization, path: str) -> tuple[Finding, ...]:
    """Return the findings on the ways through the controller, and those about the plant itself."""
    own = (f for f in model.findings if isinstance(f, BlockFinding) and f.block == path)
    return tuple(dict.fromkeys((*model.carried, *own)))


def _cut_controller(
    matrices: FourMatrices,
    states: Sequence[str],
    path: str,
    wires: Mapping[str, Wire],
    flat: FlatDiagram,
    signal: Tap | None,
) -> StateMatrices:
    """Return the matrices from the plant's outputs and the measured force to its inputs, without the plant's states."""
    A, B, C, D = matrices
    own = [_is_of(path, name) for name in states]
    keep = [i for i, mine in enumerate(own) if not mine]
    first, total = dict[tuple[str, str], int](), 0  # rows of the model: all entries of each source
    for source in dict.fromkeys((wire.block, wire.port) for wire in wires.values()):
        first[source], total = total, total + math.prod(flat.checked.shapes[source])
    picked = [first[wire.block, wire.port] + e for wire in wires.values() for e in wire_entries(flat, wire)]
    hidden = [i for i, mine in enumerate(own) if mine]
    if np.any(A[np.ix_(keep, hidden)]) or np.any(C[np.ix_(picked, hidden)]):
        raise OptionError(
            "found a way from its states to its inputs besides its outputs; expected none. Report this diagram as an "
            "error of loopwright.",
            block=path,
        )
    D = D[picked].copy()
    if signal is not None and signal.port in first:  # it is measured ahead of what is injected there
        taken = [first[signal.port] + e for e in signal.entries]
        for j, entry in enumerate(taken, D.shape[1] - len(taken)):
            D[[i for i, one in enumerate(picked) if one == entry], j] += 1.0
    return StateMatrices(A[np.ix_(keep, keep)], B[keep], C[np.ix_(picked, keep)], D)


def _is_of(path: str, state: str) -> bool:
    """Return whether a state is the plant's, or an output of it that is held."""
    return state.startswith((f"{path}.", f"held({path}."))


def _linearize_plant(diagram: WiredDiagram, at: OperatingPoint, path: str) -> PlantEquations:
    try:
        return linearize_plant(diagram, at, path)
    except FmuError as error:
        raise ParameterError(
            f"found no model of its equations ({error.message.rstrip('.')}); expected one. An identified model does "
            "not do: it holds the force over a sample, as no environment does. Take an FMU with model exchange or "
            "directional derivatives.",
            block=path,
        ) from error


def _check_held(
    diagram: WiredDiagram, at: OperatingPoint, path: str, model: Linearization, outputs: list[str], sources: list[str]
) -> None:
    """Refuse signals around a plant with equations that change between the ticks of a sampled diagram."""
    if not model.dt:
        return
    moving = "" if diagram.blocks[path].stepped else moves_between_ticks(diagram, at, outputs, sources)
    if moving:
        exchanged = diagram.blocks[path].in_model_exchange
        advice = "Take co-simulation for it, interface='co_simulation'" if exchanged else "Give it as an FMU"
        raise OptionError(
            f"found {moving!r}, which acts on continuous blocks between the ticks; expected a plant whose inputs are "
            f"held and whose outputs are sampled. {advice}, or sample the blocks around it.",
            block=path,
        )


def _check_rest(path: str, m: PlantEquations, model: Linearization) -> None:
    slow = np.max(np.abs(m.f) / (1.0 + np.abs(m.x0)), initial=0.0)
    residual = float(max(slow, np.max(np.abs(model.affine), initial=0.0)))
    if not residual <= AT_REST:
        raise ParameterError(
            f"found a point at which states change, by {residual:.3g} in a second or a sample; expected rest, to "
            f"{AT_REST:g}. Give such a point: at=diagram.trim(…).",
            block=path,
        )


def _check_contact(
    path: str, ports: Ports, m: PlantEquations, E: StateMatrices, entries: tuple[list[int], list[int], list[int]]
) -> None:
    """Refuse a velocity that is not the rate of its position, and a force that moves it at once or not at all."""
    pushed, position, velocity = entries
    P, V = m.C[position], m.C[velocity]
    rate, size = P @ m.A, np.abs(P) @ np.abs(m.A) + np.abs(V)
    error = np.abs(P) @ E.A + E.C[position] @ np.abs(m.A) + E.C[velocity]
    at_once = np.vstack([P @ m.B, m.D[position], m.D[velocity]])
    unsure = np.vstack([np.abs(P) @ E.B, E.D[position], E.D[velocity]])
    scale = np.abs(V) @ np.abs(m.B)
    if np.any(np.abs(rate - V) > _ROUNDED * (size + np.max(np.abs(V))) + _DOUBTFUL * error) or np.any(
        np.abs(at_once) > _ROUNDED * np.max(scale, initial=0.0) + _DOUBTFUL * unsure
    ):
        raise ParameterError(
            f"found {ports.velocity!r}, which is not the rate of {ports.position!r}; expected position and velocity of "
            "the point that the force acts on. Name other outputs: position=…, velocity=….",
            block=path,
            port=ports.velocity,
        )
    mobility = V @ m.B[:, pushed]
    symmetric = 0.5 * (mobility + mobility.T)
    if not np.all(np.linalg.eigvalsh(symmetric) > _ROUNDED * np.max(np.abs(symmetric), initial=0.0)):
        raise ParameterError(
            f"found a force whose accelerations are {mobility.tolist()} for each newton; expected it to push along "
            f"itself in every direction. Name a position in the axes of the force.",
            block=path,
            port=ports.force,
        )
