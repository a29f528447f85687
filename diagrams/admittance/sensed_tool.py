"""The tool beyond the force sensor of a contact.

A model with another tool adds the inertia of the difference, −Δm p̈, where it adds the environment's force. A run gives
the diagram's `ForceSensor` another tool. The two are one loop only where that sensor measures the acceleration of the
contact, and all that the environment's force reaches is reached through the sensor. `find_tool` checks it, and
`Tool.check` refuses another mass where it isn't so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...blocks import ForceSensor
from ...blocks.core import OptionError
from ..linearization import Linearization, PlantEquations, Tap
from .contact_ports import Ports
from .force_entry import SAME, find_sensor, find_upstream

if TYPE_CHECKING:
    from ..flat import FlatDiagram

_EQUAL = 1e-6
"""Relative error of the acceleration in a linear model of differences."""
_NOTHING = 1e-9
"""Slope of the acceleration by a state of the plant that counts as rounding, in 1/s² or 1/s times the velocity's slope.

A robot without friction, stiffness and gravity has none, but for the rounding of terms that cancel. A plant with less
than this moves by itself below 3e-5 rad/s only.
"""


@dataclass(frozen=True)
class Tool:
    """Tool beyond the force sensor of a contact.

    Attributes
    ----------
    sensor : str or None
        Path of the force sensor; None without one.
    mass : float
        Its mass in kg.
    problem : str
        Reason why the loop with another tool is not known; "" if it is.
    """

    sensor: str | None = None
    mass: float = 0.0
    problem: str = ""

    def check(self) -> None:
        """Refuse another tool where a model and a run would be different loops.

        Raises
        ------
        OptionError
            With the reason.
        """
        if self.problem:
            raise OptionError(self.problem, block=self.sensor or "", port="tool_mass")


def find_tool(
    flat: FlatDiagram,
    ports: Ports,
    model: PlantEquations,
    signal: Tap | None,
    entry: Tap | None,
    linear: Callable[[Sequence[str]], Linearization],
    *,
    sampled: bool,
) -> Tool:
    """Return the tool of a contact.

    Parameters
    ----------
    flat : FlatDiagram
        The diagram.
    ports : Ports
        Plant and its ports.
    model : PlantEquations
        Linear model of the plant.
    signal, entry : Tap, optional
        Measured force, and the wire to which the environment's force is added.
    linear : function
        Linear model from wires to the plant's inputs, with the plant's outputs opened.
    sampled : bool
        Whether the controller is sampled.
    """
    if signal is None or entry is None or signal.port[0] == ports.plant:
        return Tool()
    blocks = flat.table.blocks
    path = find_sensor(flat, signal.port[0])
    if path is None:
        to_plant = {p for (b, _), wire in flat.table.wires.items() if b == ports.plant
                    for p in find_upstream(flat, wire.block, ports.plant)}  # fmt: skip
        ahead = find_upstream(flat, signal.port[0], ports.plant)
        found = sorted(
            p for p, block in blocks.items() if isinstance(block, ForceSensor)
            and (p in ahead or (p in to_plant and entry.port[0] in find_upstream(flat, p, ports.plant)))
        )  # fmt: skip
        if len(found) > 1:
            names = ", ".join(map(repr, found))
            return Tool(problem=f"found the force sensors {names} on the ways of {signal.name!r}; expected one, to "
                        f"tell whose tool it is. {_advise(found[0])}")  # fmt: skip
        path = found[0] if found else None
    if path is None:
        return Tool()
    sensor = blocks[path]
    assert isinstance(sensor, ForceSensor)
    return Tool(path, sensor.tool_mass, _find_problem(flat, ports, model, entry, path, linear, sampled=sampled))


def _find_problem(
    flat: FlatDiagram,
    ports: Ports,
    model: PlantEquations,
    entry: Tap,
    path: str,
    linear: Callable[[Sequence[str]], Linearization],
    *,
    sampled: bool,
) -> str:
    """Return the reason why a model with another tool would differ from a run with it; "" if it would not."""
    wire = flat.table.wires.get((path, "acceleration"))
    own = wire is not None and wire.block == ports.plant and wire.index is None
    if wire is None or not own or not _is_acceleration(model, ports, wire.port):
        return (
            f"its acceleration is not that of {ports.plant}.{ports.velocity}; expected an output of the plant with it, "
            f"wired at once, to know the inertia of another tool. {_advise(path)}"
        )
    driven = model.inputs.entries([p for q, p in flat.table.wires if q == ports.plant and p != ports.force])
    V = model.C[model.outputs.entries([ports.velocity])]
    if sampled and not flat.table.blocks[ports.plant].stepped and np.any(V @ model.B[:, driven]):
        return (
            "it samples the acceleration of a plant with equations under the new inputs; expected that under the last "
            f"ones, as of an FMU. {_advise(path)}"
        )
    if entry.port == (path, "measured"):
        return ""
    here = flat.table.wires.get((path, "force"))
    at_once = here is not None and (here.block, here.port) == entry.port
    if (len(flat.distinct) < 2 or at_once) and _reach_alike(linear([entry.name, f"{path}.measured"])):
        return ""
    return (
        f"found another way from {entry.name!r} to the controller than the one from {path}.measured; expected the "
        f"environment's force to act as the tool's inertia does. {_advise(path)}"
    )


def _advise(path: str) -> str:
    return f"Give the tool to the diagram itself: replace({{'{path}.tool_mass': …}})."


def _is_acceleration(model: PlantEquations, ports: Ports, port: str) -> bool:
    """Whether an output of the plant is the derivative of its velocity."""
    rows, V = model.outputs.entries([port]), model.C[model.outputs.entries([ports.velocity])]
    nothing = _NOTHING * float(np.max(np.abs(V), initial=0.0))
    pairs = ((model.C[rows], V @ model.A, nothing), (model.D[rows], V @ model.B, 0.0))
    return len(rows) == len(V) and all(
        np.allclose(found, expected, rtol=_EQUAL, atol=least + _EQUAL * np.max(np.abs(expected), initial=0.0))
        for found, expected, least in pairs
    )


def _reach_alike(model: Linearization) -> bool:
    """Whether the two halves of a model's inputs act alike on its outputs."""
    half = model.B.shape[1] // 2
    if model.B.shape[1] != 2 * half:
        return False

    def alike(M: np.ndarray) -> bool:
        return bool(np.all(np.abs(M[:, :half] - M[:, half:]) <= SAME * max(1.0, float(np.max(np.abs(M), initial=0.0)))))

    B = model.B
    for _ in range(len(model.A)):
        if not alike(model.C @ B):
            return False
        B = model.A @ B
        scale = float(np.max(np.abs(B), initial=0.0))
        B = B / scale if scale > 1.0 else B
    return alike(model.D)
