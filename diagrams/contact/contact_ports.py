"""The ports of a contact at a plant, and the wire of its measured force."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from ...blocks.core import OptionError, UnknownNameError, near, same_unit
from ..linearization import Tap, find_signal, wire_entries

if TYPE_CHECKING:
    from ..flat import FlatDiagram, WiredDiagram
    from ..wiring import Wire


class PortNames(NamedTuple):
    """Names that a user gives to the ports of a contact; None where they follow from the diagram and the port.

    The measured force is a wire; None where the controller doesn't measure it.
    """

    port: str | None = None
    position: str | None = None
    velocity: str | None = None
    force: str | None = "force"

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> PortNames:
        """Return the names among given entries; ``force=False`` is None, which a TOML file doesn't have."""
        names = {name: given[name] for name in cls._fields if name in given}
        return cls(**{name: None if name == "force" and value is False else value for name, value in names.items()})


@dataclass(frozen=True)
class Ports:
    """The plant of a contact and its ports, by name."""

    plant: str
    force: str
    position: str
    velocity: str

    @classmethod
    def find(cls, diagram: WiredDiagram, flat: FlatDiagram, names: PortNames) -> Ports:
        """Return the ports that names denote."""
        force = diagram.contact_port if names.port is None else names.port
        if force is None:
            raise UnknownNameError(
                "found no port at which the environment pushes; expected an input of the plant. Name it, such as "
                "port='robot.force'.",
                block=diagram.name,
                port="port",
            )
        parts = str(force).split(".")  # an FMU's port may have a name with dots
        pairs = [(".".join(parts[:cut]), ".".join(parts[cut:])) for cut in range(len(parts) - 1, 0, -1)]
        plant, port = next((pair for pair in pairs if pair[0] in diagram.blocks), ("", ""))
        if (
            str(force) in diagram.blocks and len(inputs := list(diagram.blocks[str(force)].inputs)) == 1
        ):  # by its block's name
            plant, port = str(force), inputs[0]
        if not plant:
            candidates = [f"{path}.{name}" for path, block in diagram.blocks.items() for name in block.inputs]
            raise UnknownNameError(
                f"found no block with the input {force!r}. {near(str(force), candidates)}", block=diagram.name
            )
        if port not in diagram.blocks[plant].inputs:
            raise UnknownNameError(
                f"it has no input {port!r}. {near(port, diagram.blocks[plant].inputs)}", block=plant, port=port
            )
        found = []
        for given, quantity in ((names.position, "position"), (names.velocity, "velocity")):
            name = f"{plant}.{quantity}" if given is None else given
            signal = find_signal(flat, name)
            if signal.port[0] != plant or signal.entry:
                raise OptionError(
                    f"found {name!r}, of the block {signal.port[0]!r}; expected the {quantity} of the contact, an "
                    f"output of {plant!r} that the force acts on. Name that output: {quantity}=….",
                    block=plant,
                    port=quantity,
                )
            found.append(signal.port[1])
        return cls(plant, port, *found)


def check_unit(diagram: WiredDiagram, path: str, ports: Ports, signal: Tap) -> None:
    """Refuse a measured force in another unit than the force itself, where both are known."""
    force, measured = diagram.blocks[path].inputs[ports.force].unit, diagram.checked.units.get(signal.port)
    if isinstance(force, str) and isinstance(measured, str) and not same_unit(force, measured):
        raise OptionError(
            f"found {signal.name!r} in {measured}; expected the measured force in {force}, as of {path}.{ports.force}. "
            "Name the wire that has it: force=….",
            block=path,
            port=ports.force,
        )


def check_command(flat: FlatDiagram, ports: Ports, signal: Tap, wires: Mapping[str, Wire]) -> None:
    """Refuse a measured force that is a command of the plant: it drives another of its inputs."""
    for port, source in wires.items():
        if port == ports.force or (source.block, source.port) != signal.port:
            continue
        if set(wire_entries(flat, source)) & set(signal.entries):
            raise OptionError(
                f"found {signal.name!r}, which drives {ports.plant}.{port}; expected the signal of the force sensor, "
                "which acts on the controller alone. Name that wire: force=….",
                block=ports.plant,
                port=ports.force,
            )


def force_wire_error(flat: FlatDiagram, ports: Ports, signal: Tap) -> OptionError:
    """Return the error of a measured force that leads on to the force port: the environment's force would act twice."""
    readers = sorted(
        {
            f"{path}.{port}"
            for (path, port), wire in flat.table.wires.items()
            if (wire.block, wire.port) == signal.port and path != ports.plant
        }
    )
    return OptionError(
        f"found {signal.name!r}, which leads on to {ports.plant}.{ports.force}, and is read by {', '.join(readers)}; "
        "expected a wire that acts on the controller alone. Put a Gain(gain=1, name='cell') on the wire to those of "
        "them that belong to the controller, and name its output: force='cell.y'.",
        block=ports.plant,
        port=ports.force,
    )
