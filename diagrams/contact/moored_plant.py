"""Diagrams whose plant has an environment inside: spring, damper and mass as a part of the plant's own equations.

An FMU of a plant of the library is built again, with the environment in it. It keeps the parameters and start values of
the diagram's FMU. A plant that is a block of the diagram is replaced by one with the environment.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks import Hold, Sum
from ...blocks.core import Array, Block, OptionError, Output, parameter
from ...fmus.export import build
from ...fmus.fmu_block import Fmu
from ...fmus.models import gantry, gantry_elastic, gantry_stiction, scara
from ..wiring import Structure, Wire

if TYPE_CHECKING:
    from pathlib import Path

    from ..flat import WiredDiagram
    from ..linearization import Tap


INTERNAL_STEP = 1e-4
"""Longest internal step in s of an FMU with an environment: its contact is faster than the plant alone."""
LIBRARY = {
    model.__name__.rpartition(".")[2]: type(model.nominal) for model in (gantry, gantry_elastic, gantry_stiction, scara)
}
"""Plants of the library with a force port, by the names of their FMUs' models."""
FORCE = "environment_force"
"""Output with the force of the environment."""


@dataclass(frozen=True)
class Mooring:
    """An environment that is put into a plant."""

    direction: np.ndarray  # unit vector along which it acts
    anchor: np.ndarray  # place where its spring is relaxed
    stiffness: float = 0.0  # N/m
    damping: float = 0.0  # N·s/m
    mass: float = 0.0  # kg
    kick: float = 0.0  # force in N in its direction, which sets it in motion
    kick_time: float = 0.0  # end of the kick in s
    kick_start: float = 0.0  # its beginning in s

    def parameters(self) -> dict[str, Any]:
        """Return the parameters of a moored plant."""
        names = ("direction", "anchor", "stiffness", "damping", "mass", "kick", "kick_time")  # begun at its start
        return {f"environment_{name}": getattr(self, name) for name in names}


class _Pushed:
    """Inputs of a plant, with another force at one port."""

    def __init__(self, u: Any, port: str, force: Any):
        self._inputs, self._port, self._force = u, port, force

    def __getattr__(self, name: str) -> Any:
        return self._force if name == self._port else getattr(self._inputs, name)


def moor(plant: type[Block], port: str, position: str, velocity: str) -> type[Block]:
    """Return the class of a plant with an environment inside; its acceleration has to be affine in the force."""

    def read(block: Block, t: Array, x: Any, u: Any, name: str) -> Any:
        if name in block.states:
            return getattr(x, name)
        own = [output for output in block.outputs if output not in block.states and output != FORCE]
        found = plant.output(block, t, x, u)  # type: ignore[attr-defined]
        return (found if isinstance(found, tuple) else (found,))[own.index(name)]

    def rate(block: Block, t: Array, x: Any, u: Any) -> Any:
        """Return the acceleration of the contact: the velocity's derivative, or the output of that name."""
        if velocity in block.states:
            found = plant.derivative(block, t, x, u)  # type: ignore[attr-defined]
            return (found if isinstance(found, tuple) else (found,))[list(block.states).index(velocity)]
        return read(block, t, x, u, "acceleration")

    class MooredPlant(plant):  # type: ignore[valid-type,misc]
        """The plant with an environment in one direction."""

        environment_direction: Array = parameter(default=(1.0, 0.0), shape=(2,), unit="1", description="unit vector")
        environment_anchor: Array = parameter(default=(0.0, 0.0), shape=(2,), unit="m", description="spring is relaxed")
        environment_stiffness: float = parameter(default=0.0, unit="N/m", description="stiffness k_e")
        environment_damping: float = parameter(default=0.0, unit="N.s/m", description="damping b_e")
        environment_mass: float = parameter(default=0.0, unit="kg", description="mass m_e")
        environment_kick: float = parameter(default=0.0, unit="N", description="force at the beginning")
        environment_kick_time: float = parameter(default=0.0, unit="s", description="end of that force")
        environment_force = Output(shape=(2,), unit="N", description="force of the environment on the plant")

        def moored_force(self, t: Array, x: Any, u: Any) -> Array:
            """Return the force of the environment; a mass moves along, which is solved for the force."""
            d = self.environment_direction
            p, v = (read(self, t, x, u, name) for name in (position, velocity))
            f = np.where(t < self.environment_kick_time, self.environment_kick, 0.0)
            f = (
                f
                - self.environment_stiffness * (d @ (p - self.environment_anchor))
                - self.environment_damping * (d @ v)
            )
            # the acceleration is affine in the force: two evaluations give its value without the force, and its slope
            there = [_Pushed(u, port, getattr(u, port) + d * force) for force in (0.0, 1.0)]
            a0, a1 = (d @ rate(self, t, x, pushed) for pushed in there)
            return d * ((f - self.environment_mass * a0) / (1.0 + self.environment_mass * (a1 - a0)))

        def _moored(self, t: Array, x: Any, u: Any) -> tuple[_Pushed, Array]:
            force = self.moored_force(t, x, u)
            return _Pushed(u, port, getattr(u, port) + force), force

        def derivative(self, t: Array, x: Any, u: Any) -> Any:
            """Return the plant's own derivative under the force."""
            return plant.derivative(self, t, x, self._moored(t, x, u)[0])  # type: ignore[attr-defined]

        def output(self, t: Array, x: Any, u: Any) -> Any:
            """Return the plant's own outputs under the force, and the force; nothing has acted yet at the start."""
            pushed, force = self._moored(t, x, u)
            found = plant.output(self, t, x, pushed)  # type: ignore[attr-defined]
            found = found if isinstance(found, tuple) else (found,)
            return *found, np.where(t > 0.0, force, 0.0 * force)

    return MooredPlant


@cache
def _moored_file(name: str, port: str, position: str, velocity: str) -> Path:
    """Return the FMU of a plant of the library with an environment inside."""
    return build(moor(LIBRARY[name], port, position, velocity)(), name=f"moored_{name}", internal_step=INTERNAL_STEP)


def library_class(block: Block) -> type[Block] | None:
    """Return the class of the plant of the library that a block is, or is the FMU of by its name; None for others."""
    if not isinstance(block, Fmu):
        known = [cls for cls in LIBRARY.values() if type(block) is cls]
        return known[0] if known else None
    found = LIBRARY.get(block.description.model_name)
    parameters = {name for name in (found.parameter_specs if found else ()) if name[:6] != "start_"}
    return found if found is not None and parameters <= set(block.description.variables) else None


def moored_diagram(
    diagram: WiredDiagram,
    plant: str,
    ports: tuple[str, str, str],
    measured: Tap | None,
    mooring: Mooring,
    tool: Mapping[str, float] | None = None,
) -> WiredDiagram:
    """Return a diagram with an environment inside its plant; the measured force has the environment's.

    ``ports`` are those of force, position and velocity at the contact; ``measured`` and ``tool`` are those of
    `attach_environment`.
    """
    block = diagram.blocks[plant]
    cls = library_class(block)
    if cls is None:
        raise OptionError(
            f"found {type(block).__name__}, which is no plant of the library; expected one of {', '.join(LIBRARY)}.",
            block=plant,
        )
    table = copy_table(diagram, tool)
    if isinstance(block, Fmu):
        names = {new: old for old, new in block.rename.items()}
        force, position, velocity = (names.get(port, port) for port in ports)
        file = _moored_file(block.description.model_name, force, position, velocity)
        table.blocks[plant] = block.replace(file=file, start={**_own_start(block, cls), **mooring.parameters()})
    else:
        values = {name: getattr(block, name) for name in cls.parameter_specs}
        made: Any = moor(cls, *ports)
        table.blocks[plant] = made(
            **{k: v for k, v in values.items() if v is not None}, **mooring.parameters(), name=block.label
        )
    if measured is not None:
        felt = hold_separately(table, measured.port[0], Wire(plant, FORCE), "environment_held")
        total = "environment_sum"
        while total in table.blocks or total in table.subsystems:
            total += "_"
        add_forces(table, measured, [felt], total, {(plant, ports[0])})
    return diagram.with_structure(table)


def copy_table(diagram: WiredDiagram, tool: Mapping[str, float] | None) -> Structure:
    """Return a copy of a diagram's structure, in which the delays of subsystems are blocks, and sensors have tools.

    ``tool`` holds the mass in kg beyond a force sensor, by the sensor's path.
    """
    table = diagram.scheduled.copy()
    for path, settings in table.subsystems.items():
        table.subsystems[path] = replace(settings, delay=0)
    for path, mass in (tool or {}).items():
        table.blocks[path] = table.blocks[path].replace(tool_mass=mass)
    return table


def add_forces(
    table: Structure, measured: Tap, forces: Sequence[Wire], total: str, others: Collection[tuple[str, str]]
) -> None:
    """Add forces to a measured one, by a sum of the path ``total``, for all readers but the inputs ``others``."""
    for group in (table.wires, table.controls):
        for key, wire in list(group.items()):
            if (wire.block, wire.port) == measured.port and key not in others:
                group[key] = Wire(total, "y", wire.index)  # type: ignore[index]
    table.blocks[total], table.subsystem_of[total] = Sum(signs="+" * (1 + len(forces)), name=total), ""
    for i, wire in enumerate((Wire(*measured.port), *forces), 1):
        table.wires[total, f"u{i}"] = wire


def hold_separately(table: Structure, block: str, wire: Wire, name: str) -> Wire:
    """Return the wire of a signal as it is at the ticks of a block; the signal's own where all ticks are the same."""
    subsystem = table.subsystem_of[block]
    clocks = {(settings.sample_time, settings.offset) for settings in table.subsystems.values() if settings.sample_time}
    if len(clocks) < 2 or not table.is_sampled(subsystem):
        return wire
    path = f"{subsystem}.{name}"
    table.blocks[path], table.subsystem_of[path] = Hold(name=name), subsystem
    table.wires[path, "u"] = wire
    return Wire(path, "y")


def _own_start(block: Fmu, cls: type[Block]) -> Mapping[str, Any]:
    """Return the values of an FMU's parameters and states, as start values of another FMU of the plant."""
    known = block.description.variables
    names = [name for name in (*cls.parameter_specs, *_states(cls)) if name in known and name[:6] != "start_"]
    found = {name: known[name].start for name in names if known[name].start is not None}
    own = {name: value for name, value in block.start.items() if name in {*known} - {"internal_step"}}
    return {**found, **own}


def _states(cls: type[Block]) -> tuple[str, ...]:
    return tuple(cls().states)
