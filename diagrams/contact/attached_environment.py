"""Diagrams whose plant is pushed by an environment that is a block next to it.

In the solver: the plant is a block with equations, or an FMU in model exchange, and the environment's force follows its
motion within each step. Held: the plant is an FMU in co-simulation, which gets the force at communication points
`SUBSTEPS` times as dense as the ticks, and keeps it between them.

The controller of a sampled diagram reads the outputs of a co-simulation FMU as they are at the end of a step, under the
last inputs. An FMU in model exchange has feedthrough at a tick. So those of its outputs, and the inertial force of the
environment's mass, are sampled `EARLY` of a tick before it.
"""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks import Constant, Hold, Step
from ...blocks.core import AlgebraicLoopError, Array, Block, Input, OptionError, Output, State, parameter
from ...fmus.fmu_block import Fmu
from ..linearization import PlantEquations
from ..wiring import Structure, SubsystemSettings, Wire
from .contact_ports import Ports
from .moored_plant import Mooring, add_forces, copy_table, hold_separately

if TYPE_CHECKING:
    from ..flat import WiredDiagram
    from ..linearization import Tap


SUBSTEPS = 10
"""Communication points of an FMU in a tick, where the environment's force is held between them."""
EARLY = Fraction(1, 1000)
"""Part of a tick by which outputs with feedthrough are sampled before it."""
BLOCK = "environment"
_ROUNDED = 1e-9
"""Relative size of an entry that should be zero."""


class Environment(Block):
    """Spring, damper and mass along a direction: f = −k dᵀ(p − p₀) − b dᵀv − m dᵀa; the kick is not measured."""

    direction: Array = parameter(unit="1", description="unit vector d")
    anchor: Array = parameter(unit="m", description="place where the spring is relaxed")
    stiffness: float = parameter(default=0.0, unit="N/m", minimum=0.0, description="stiffness k_e")
    damping: float = parameter(default=0.0, unit="N.s/m", minimum=0.0, description="damping b_e")
    mass: float = parameter(default=0.0, unit="kg", minimum=0.0, description="mass m_e")
    kick = Input(description="force in the first instants")
    push = Input(shape=None, description="force on the plant without the environment")
    position = Input(shape=None, description="position of the contact")
    velocity = Input(shape=None, description="velocity of the contact")
    acceleration = Input(shape=None, description="acceleration of the contact")
    total = Output(like="push", description="force on the plant")
    force = Output(like="push", description="force of spring and damper")
    inertia = Output(like="push", description="force of the mass; nothing has acted yet at the start")

    def output(self, t: Array, x: Any, u: Any) -> tuple[Array, Array, Array]:
        """Return the forces."""
        d = self.direction
        f = -self.stiffness * along(d, u.position - self.anchor) - self.damping * along(d, u.velocity)
        force, inertia = d * f, -self.mass * along(d, u.acceleration) * d
        return u.push + d * u.kick + force + inertia, force, np.where(t > 0.0, inertia, 0.0 * inertia)

    def after_start(self, x: Any, u: Any, T: float | None) -> tuple[()]:
        """Return no states: the branch of the start is ``t > 0``."""
        return ()


class HeldEnvironment(Block):
    """The environment at communication points: its force is held between them.

    The mass's force is solved with the mobility μ of the plant: a step's mean acceleration dᵀΔv/h is that which the
    plant has by itself, and μ times the force that was held. The kick is not measured.
    """

    direction: Array = parameter(unit="1", description="unit vector d")
    anchor: Array = parameter(unit="m", description="place where the spring is relaxed")
    stiffness: float = parameter(default=0.0, unit="N/m", minimum=0.0, description="stiffness k_e")
    damping: float = parameter(default=0.0, unit="N.s/m", minimum=0.0, description="damping b_e")
    mass: float = parameter(default=0.0, unit="kg", minimum=0.0, description="mass m_e")
    mobility: float = parameter(unit="1/kg", above=0.0, description="acceleration along d by a force along d")
    kick = Input(description="force in the first instants")
    push = Input(shape=None, description="force on the plant without the environment")
    position = Input(shape=None, description="position of the contact")
    velocity = Input(shape=None, description="velocity of the contact")
    total = Output(like="push", description="force on the plant")
    force = Output(like="push", description="force of the environment")
    last_velocity = State(start=0.0, description="velocity along d at the last communication point")
    last_force = State(start=0.0, description="force along d since then")

    def solve(self, x: Any, u: Any, T: Array) -> Array:
        """Return the force along d."""
        d, m = self.direction, self.mass
        f = -self.stiffness * along(d, u.position - self.anchor) - self.damping * along(d, u.velocity)
        own = (along(d, u.velocity) - x.last_velocity) / T - self.mobility * x.last_force
        return (f - m * own) / (1.0 + m * self.mobility)

    def output(self, t: Array, x: Any, u: Any, T: Array) -> tuple[Array, Array]:
        """Return the forces."""
        force = self.direction * self.solve(x, u, T)
        return u.push + self.direction * u.kick + force, force

    def update(self, t: Array, x: Any, u: Any, T: Array) -> tuple[Array, Array]:
        """Keep velocity and force."""
        return along(self.direction, u.velocity), self.solve(x, u, T) + u.kick


def along(direction: Array, vector: Array) -> Array:
    """Return the part of a vector along a direction; of a number, their product."""
    return np.sum(direction * vector)


def attach_environment(
    diagram: WiredDiagram,
    ports: Ports,
    model: PlantEquations,
    measured: Tap | None,
    mooring: Mooring,
    tool: Mapping[str, float] | None,
    tick: Fraction | None,
    *,
    held: bool = False,
) -> WiredDiagram:
    """Return a diagram with an environment next to its plant; the measured force has the environment's.

    ``measured`` is the wire to which its force is added, for all readers but the plant. ``tool`` holds the mass in kg
    beyond a force sensor, by the sensor's path. ``tick`` is the sample time in s of a sampled diagram. With ``held``
    the plant stays in co-simulation, and the force is held between communication points.
    """
    path, block = ports.plant, diagram.blocks[ports.plant]
    table = copy_table(diagram, tool)
    taken = {*table.blocks, *table.subsystems}
    name = next(n for n in (BLOCK + "_" * k for k in range(99)) if n not in taken)
    shape = np.shape(mooring.anchor)
    push = table.wires.get((path, ports.force), None)
    if push is None:
        push = _add(table, Constant(value=_idle(block, ports.force, shape), name=f"{name}_push"), "y")
    times = (mooring.kick_start, mooring.kick_time)
    kick = _add(table, Step(times=times, values=(mooring.kick, 0.0), name=f"{name}_kick"), "y")
    inputs = {"kick": kick, "push": push} | {q: Wire(path, getattr(ports, q)) for q in ("position", "velocity")}
    d = np.asarray(mooring.direction).reshape(shape)
    values: dict[str, Any] = {
        "name": name,
        "direction": d if shape else float(d),
        "anchor": mooring.anchor if shape else float(mooring.anchor),
        **{key: getattr(mooring, key) for key in ("stiffness", "damping", "mass")},
    }
    if held:
        assert tick is not None
        put_at, forces = _put_held(table, ports, model, values, inputs, tick)
    else:
        put_at, forces = _put_in_solver(table, ports, model, values, inputs, tick, is_felt=measured is not None)
    table.wires[path, ports.force] = Wire(put_at, "total")
    if measured is not None:
        forces[0] = hold_separately(table, measured.port[0], forces[0], f"{name}_felt")
        add_forces(table, measured, forces, f"{name}_sum", {(put_at, port) for port in inputs})
    try:
        return diagram.with_structure(table)
    except AlgebraicLoopError:  # by a mass, a continuous controller, or an FMU that does not list its dependencies
        return diagram.with_structure(table, loops="solve")


def _put_held(
    table: Structure,
    ports: Ports,
    model: PlantEquations,
    values: Mapping[str, Any],
    inputs: Mapping[str, Wire],
    tick: Fraction,
) -> tuple[str, list[Wire]]:
    """Put the environment into a subsystem with communication points; return its path, and the forces that are felt."""
    subsystem, d = f"{values['name']}_sampling", np.ravel(values["direction"])
    mobility = model.C[model.outputs.entries([ports.velocity])] @ model.B[:, model.inputs.entries([ports.force])]
    table.subsystems[subsystem] = SubsystemSettings(subsystem, tick / SUBSTEPS, None)
    made = HeldEnvironment(**values, mobility=float(d @ np.asarray(mobility) @ d))
    force = _add(table, made, "force", subsystem, inputs)
    return force.block, [force]


def _put_in_solver(
    table: Structure,
    ports: Ports,
    model: PlantEquations,
    values: Mapping[str, Any],
    inputs: Mapping[str, Wire],
    tick: Fraction | None,
    *,
    is_felt: bool,
) -> tuple[str, list[Wire]]:
    """Put the environment next to a plant with equations; return its path, and the forces that are felt."""
    path, name = ports.plant, values["name"]
    block, is_stepped, outputs = table.blocks[path], table.blocks[path].stepped, [*table.blocks[path].outputs]
    if isinstance(block, Fmu) and is_stepped:
        table.blocks[path] = block.replace(interface="model_exchange")
    if values["mass"]:
        acceleration = _find_acceleration(table, ports, model)
    else:
        acceleration = _add(table, Constant(value=np.zeros(np.shape(values["anchor"])), name=f"{name}_still"), "y")
    sampling = f"{name}_sampling"
    if tick is not None:
        table.subsystems[sampling] = SubsystemSettings(sampling, tick, None, offset=tick * (1 - EARLY))
        if is_stepped:
            used = {wire.port for wire in table.wires.values() if wire.block == path}
            early = [port for port in outputs if port in used and np.any(model.D[model.outputs.entries([port])])]
            before = {(path, port): _sample(table, sampling, Wire(path, port), f"{port}_before") for port in early}
            _reroute(table, before)
    force = _add(table, Environment(**values), "force", "", {**inputs, "acceleration": acceleration})
    forces = [force]
    if values["mass"] and is_felt:
        inertia = Wire(force.block, "inertia")
        forces.append(inertia if tick is None else _sample(table, sampling, inertia, "inertia_before"))
    return force.block, forces


def _add(
    table: Structure, block: Block, port: str, subsystem: str = "", inputs: Mapping[str, Wire] | None = None
) -> Wire:
    """Add a block with the wires of its inputs, and return the wire of one of its outputs."""
    path = f"{subsystem}.{block.name}" if subsystem else str(block.name)
    table.blocks[path], table.subsystem_of[path] = block, subsystem
    table.wires.update({(path, name): wire for name, wire in (inputs or {}).items()})
    return Wire(path, port)


def _sample(table: Structure, subsystem: str, wire: Wire, name: str) -> Wire:
    """Return the wire of a signal that is sampled in a subsystem."""
    return _add(table, Hold(name=name), "y", subsystem, {"u": wire})


def _reroute(table: Structure, changes: Mapping[tuple[str, str], Wire]) -> None:
    """Lead the readers of ports to other wires, but for the blocks that these come from."""
    new = {wire.block for wire in changes.values()}
    for group in (table.wires, table.controls):
        for key, wire in list(group.items()):
            if (wire.block, wire.port) in changes and not (isinstance(key, tuple) and key[0] in new):
                other = changes[wire.block, wire.port]
                group[key] = Wire(other.block, other.port, wire.index)  # type: ignore[index]


def _idle(block: Block, port: str, shape: tuple[int, ...]) -> Any:
    """Return the force at a port to which nothing is wired."""
    value: Any = block.inputs[port].default
    if isinstance(block, Fmu):
        name = {new: old for old, new in block.rename.items()}.get(port, port)
        value = block.start.get(name, block.description.find(name).start)
    return np.broadcast_to(np.asarray(0.0 if value is None else value, dtype=float), shape).copy()


def _find_acceleration(table: Structure, ports: Ports, model: PlantEquations) -> Wire:
    """Return the output with the acceleration of the contact; a plant without one gets it, from its derivatives."""
    path, block = ports.plant, table.blocks[ports.plant]
    V = model.C[model.outputs.entries([ports.velocity])]
    a, a_u = V @ model.A, V @ model.B
    for port in block.outputs:
        rows = model.outputs.entries([port])
        if len(rows) == len(V) and all(
            np.allclose(found, expected, rtol=1e-6, atol=1e-6 * np.max(np.abs(expected), initial=0.0))
            for found, expected in ((model.C[rows], a), (model.D[rows], a_u))
        ):
            return Wire(path, port)
    name = next((n for n in _states(model, path) if _is_state(model, V, f"{path}.{n}")), None)
    if name is not None and isinstance(block, Fmu):
        derivative = block.description.states.get(name)
        if derivative is not None:
            every = [*block.input_variables.values(), *block.output_variables.values()]
            chosen = [v.name for v in every] if block.ports is None else list(block.ports)
            table.blocks[path] = block.replace(
                ports=[*chosen, derivative], rename={**block.rename, derivative: "contact_acceleration"}
            )
            return Wire(path, "contact_acceleration")
    elif name is not None:
        table.blocks[path] = _show_derivative(block, name)
        return Wire(path, "contact_acceleration")
    raise OptionError(
        f"found no output with the acceleration of the contact, and {ports.velocity!r} is no state whose derivative "
        "could be shown; expected one, as a mass pushes by it. Add such an output to the plant.",
        block=path,
        port=ports.velocity,
    )


def _states(model: PlantEquations, path: str) -> list[str]:
    return list(dict.fromkeys(label.removeprefix(f"{path}.").partition("[")[0] for label in model.states))


def _is_state(model: PlantEquations, V: np.ndarray, label: str) -> bool:
    """Return whether the velocity is a state, entry by entry."""
    mine = [i for i, name in enumerate(model.states) if name.partition("[")[0] == label]
    expected = np.eye(len(model.states))[mine]
    return V.shape == expected.shape and bool(np.all(np.abs(V - expected) <= _ROUNDED))


def _show_derivative(block: Block, state: str) -> Block:
    """Return a block with equations, with the derivative of a state as an output more."""
    plant: Any = type(block)

    class Shown(plant):  # type: ignore[misc]
        """The plant with an output more."""

        contact_acceleration = Output(shape=block.states[state].shape, description="acceleration of the contact")

        def output(self, t: Array, x: Any, u: Any) -> Any:
            """Return the plant's own outputs, and the derivative of a state."""
            found = plant.output(self, t, x, u) if [n for n in plant.outputs if n not in self.states] else ()
            found = found if isinstance(found, tuple) else (found,)
            rates = plant.derivative(self, t, x, u)
            rates = rates if isinstance(rates, tuple) else (rates,)
            shown = rates[list(self.states).index(state)]
            return (*found, shown) if found else shown

    values = {name: value for name in block.parameter_specs if (value := getattr(block, name)) is not None}
    made: Block = Shown(**values).replace(name=block.label)
    return made
