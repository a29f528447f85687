"""Blocks of a diagram of Fig. 3 that a reduced loop is made from, and the wires between them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...blocks import Gain, Saturation, UnitDelay
from ...blocks.core import Finding, ParameterError, UnknownNameError
from ..linearization import find_kinks_between

if TYPE_CHECKING:
    from ..flat import WiredDiagram
    from ..results import OperatingPoint

SENSOR = "sensors.force_sensor"
_CONTROLLER = "controller"


def plant_path(diagram: WiredDiagram) -> str:
    """Return the path of the plant: the block whose acceleration is wired to the force sensor."""
    wire = diagram.structure.wires.get((SENSOR, "acceleration"))
    if wire is None:
        raise UnknownNameError(
            "found no wire to its acceleration; expected that of Fig. 3. Make the diagram with fig3().",
            block=SENSOR,
        )
    return wire.block


def find_kinks(diagram: WiredDiagram, point: OperatingPoint | None) -> tuple[Finding, ...]:
    """Return the kinks and stairs on the loops, and on the ways from the measured force to the plant's motion."""
    plant = plant_path(diagram)
    measured, moves = ([(path, port) for port in diagram.blocks[path].outputs] for path in (SENSOR, plant))
    return find_kinks_between(diagram, point, measured, moves)


def check_wires(diagram: WiredDiagram) -> None:
    """Refuse a diagram with other blocks between those that the reduced loop is made from."""
    plant, wires = plant_path(diagram), diagram.structure.wires
    for (block, port), expected in _expected_wires(diagram, plant).items():
        wire = wires.get((block, port))
        found = "nothing" if wire is None else str(wire)
        if found != expected:
            raise ParameterError(
                f"found {found}; expected {expected}: the reduced loop has nothing between them. Take it out, or "
                "linearize the diagram itself.",
                block=block,
                port=port,
            )


def _expected_wires(diagram: WiredDiagram, plant: str) -> dict[tuple[str, str], str]:
    """Return the source of each input in Fig. 3."""
    position, velocity, theta = f"{plant}.position", f"{plant}.velocity", f"{_CONTROLLER}.path_projection.theta"
    transform, linearization = f"{_CONTROLLER}.transverse_transform", f"{_CONTROLLER}.feedback_linearization"
    found: dict[tuple[str, str], str] = {(f"{_CONTROLLER}.path_projection", "position"): position}
    for block in (transform, linearization):
        found |= {(block, "theta"): theta, (block, "position"): position, (block, "velocity"): velocity}
    for block in (f"{_CONTROLLER}.force_projection", linearization):
        found |= {(block, "theta"): theta, (block, "force"): f"{SENSOR}.measured"}
    for side, coordinate in (("par", "eta"), ("perp", "xi")):
        admittance, pid = f"{_CONTROLLER}.admittance_{side}", f"{_CONTROLLER}.pid_{side}"
        found[admittance, "force"] = f"{_CONTROLLER}.force_projection.f_{side}"
        found[pid, "coordinate"] = f"{transform}.{coordinate}"
        found[pid, "reference"] = f"{admittance}.path_reference"
        found[linearization, f"v_{side}"] = f"{pid}.v"
    last = f"{linearization}.motor_force"
    for name, kind in (("saturation", Saturation), ("computation", (UnitDelay, Gain))):
        block = f"{_CONTROLLER}.{name}"
        if isinstance(diagram.blocks.get(block), kind):
            found[block, "u"], last = last, f"{block}.y"
    found[plant, "motor_force"] = last
    outside = diagram.structure.wires.get((plant, "external_force"))
    found[SENSOR, "force"] = "nothing" if outside is None else str(outside)
    if "contact_force" in diagram.blocks[plant].outputs:
        found[SENSOR, "contact_force"] = f"{plant}.contact_force"
    return found


def delay_of(diagram: WiredDiagram) -> int:
    """Return the samples of delay of the motor force: the controller's own, and that of the block ``computation``."""
    subsystems = diagram.subsystems
    controller, sensors = subsystems[_CONTROLLER], subsystems["sensors"]
    found = (sensors.sample_time, sensors.offset, sensors.delay)
    if found != (controller.sample_time, controller.offset, 0):
        settings = " s, ".join(str(v) for v in found)
        raise ParameterError(
            f"found the sample time, offset and delay {settings}; expected {controller.sample_time} s, "
            f"{controller.offset} s, 0: the reduced loop reads the sensors at the controller's ticks. Linearize the "
            "diagram itself.",
            block="sensors",
        )
    last = diagram.blocks.get(f"{_CONTROLLER}.computation")
    late = isinstance(last, UnitDelay)
    if last is not None and not late and not (isinstance(last, Gain) and bool(np.all(last.gain == 1.0))):
        raise ParameterError(
            f"found {type(last).__name__}; expected a UnitDelay, or a Gain of 1 in its place. Linearize the diagram "
            "itself.",
            block=f"{_CONTROLLER}.computation",
        )
    return controller.delay + int(late)
