"""The parts of a diagram of Fig. 3 that a reduced loop is made of, and the wires between them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks import Gain, Saturation, UnitDelay
from ...blocks.core.errors import ParameterError, UnknownNameError

if TYPE_CHECKING:
    from ..flat.wired_diagram import WiredDiagram

SENSOR = "sensors.force_sensor"
_BOX = "controller"


def plant_path(diagram: WiredDiagram) -> str:
    """Return the path of the plant: the block whose acceleration the force sensor gets.

    Raises
    ------
    UnknownNameError
        If there is no force sensor, or nothing is wired to it.
    """
    wire = diagram.structure.wires.get((SENSOR, "acceleration"))
    if wire is None:
        raise UnknownNameError(
            "found no acceleration of a plant; expected the wires of Fig. 3. Make the diagram with fig3().",
            block=SENSOR,
        )
    return wire.block


def check_wires(diagram: WiredDiagram) -> None:
    """Refuse a diagram with anything between the parts that the reduced loop is made of.

    Raises
    ------
    ParameterError
        If an input has another source than in Fig. 3: an encoder, a filter, an actuator's own dynamics.
    """
    plant, wires = plant_path(diagram), diagram.structure.wires
    for (block, port), expected in _wires(diagram, plant).items():
        wire = wires.get((block, port))
        found = "nothing" if wire is None else str(wire)
        if found != expected:
            raise ParameterError(
                f"found {found}; expected {expected}, as the reduced loop has nothing else between them. Take it out, "
                "or linearize the diagram itself.",
                block=block,
                port=port,
            )


def _wires(diagram: WiredDiagram, plant: str) -> dict[tuple[str, str], str]:
    """Return the source of each input, as Fig. 3 has it."""
    position, velocity, theta = f"{plant}.position", f"{plant}.velocity", f"{_BOX}.path_projection.theta"
    transform, linearization = f"{_BOX}.transverse_transform", f"{_BOX}.feedback_linearization"
    found: dict[tuple[str, str], str] = {(f"{_BOX}.path_projection", "position"): position}
    for block in (transform, linearization):
        found |= {(block, "theta"): theta, (block, "position"): position, (block, "velocity"): velocity}
    for block in (f"{_BOX}.force_projection", linearization):
        found |= {(block, "theta"): theta, (block, "force"): f"{SENSOR}.measured"}
    for side, coordinate in (("par", "eta"), ("perp", "xi")):
        admittance, pid = f"{_BOX}.admittance_{side}", f"{_BOX}.pid_{side}"
        found[admittance, "force"] = f"{_BOX}.force_projection.f_{side}"
        found[pid, "coordinate"] = f"{transform}.{coordinate}"
        found[pid, "reference"] = f"{admittance}.path_reference"
        found[linearization, f"v_{side}"] = f"{pid}.v"
    last = f"{linearization}.motor_force"
    for name, kind in (("saturation", Saturation), ("computation", (UnitDelay, Gain))):
        block = f"{_BOX}.{name}"
        if isinstance(diagram.blocks.get(block), kind):
            found[block, "u"], last = last, f"{block}.y"
    found[plant, "motor_force"] = last
    outside = diagram.structure.wires.get((plant, "external_force"))
    found[SENSOR, "force"] = "nothing" if outside is None else str(outside)
    outputs: Any = diagram.blocks[plant].outputs
    if "contact_force" in outputs:
        found[SENSOR, "contact_force"] = f"{plant}.contact_force"
    return found


def delay_of(diagram: WiredDiagram) -> int:
    """Return the samples by which the motor force is late: the box's own delay, and that of ``computation`` in it.

    Raises
    ------
    ParameterError
        If the sensors have another sample time, offset or delay, or ``computation`` is more than a delay.
    """
    frames = diagram.frames
    box, sensors = frames[_BOX], frames["sensors"]
    found = (sensors.sample_time, sensors.offset, sensors.delay)
    if found != (box.sample_time, box.offset, 0):
        told = " s, ".join(str(v) for v in found)
        raise ParameterError(
            f"found the sample time, offset and delay {told}; expected {box.sample_time} s, {box.offset} s, 0: the "
            "sensors' signals are taken at the controller's ticks. Linearize the diagram itself.",
            block="sensors",
        )
    last: Any = diagram.blocks.get(f"{_BOX}.computation")
    late = isinstance(last, UnitDelay)
    if last is not None and not late and not (isinstance(last, Gain) and bool(np.all(last.gain == 1.0))):
        raise ParameterError(
            f"found {type(last).__name__}; expected a UnitDelay, or a Gain of 1 in its place. Linearize the diagram "
            "itself.",
            block=f"{_BOX}.computation",
        )
    return box.delay + int(late)
