"""The measured force of a contact: the place where the environment's force enters the diagram, and the sensor's tool.

The diagram's own force on the plant comes by the wire of the force port, if there is one. The measured force is another
wire, behind the force sensor. Where the first leads to the second at once and unchanged, the environment's force is
added to the second. Where a delay, a filter, a gain or a slower clock lies between them, where the first leads to the
plant's other inputs on other ways, too, and where both are one wire, it is added to the first, for all its readers
but the plant: so it takes those ways, too.

Without a way between the two, nothing distinguishes the sensor from what follows it, and a measured wire behind states
is refused.

A model with another tool adds the inertia of the difference, −Δm p̈, where it adds the environment's force. A run gives
the diagram's `ForceSensor` another tool. The two are one loop only where that sensor measures the acceleration of the
contact, and all that the environment's force reaches is reached through the sensor. `find_tool` checks it, and
`Tool.check` refuses another mass where it isn't so.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks import ForceSensor
from ...blocks.core import OptionError
from ..linearization import Linearization, PlantEquations, Tap, find_signal, linearize
from .contact_ports import Ports

if TYPE_CHECKING:
    from ..flat import FlatDiagram, WiredDiagram
    from ..results import OperatingPoint
    from ..wiring import Wire


SAME = 1e-9
"""Relative size of an entry that should be zero."""


def find_entry(
    diagram: WiredDiagram,
    point: OperatingPoint,
    ports: Ports,
    signal: Tap,
    wires: Mapping[str, Wire],
    opened: Sequence[str],
    options: Mapping[str, Any],
) -> Tap:
    """Return the wire to which the environment's force is added."""
    flat, source = diagram.flatten_like(point), wires.get(ports.force)
    if source is not None and (source.block, source.port) == signal.port:
        return find_signal(flat, signal.name)  # measured ahead of what is added: the plant has that already
    if source is not None and source.index is None:
        port = (source.block, source.port)
        sensor = flat.table.blocks[signal.port[0]]
        wire = flat.table.wires.get((signal.port[0], "force"))
        at_once = isinstance(sensor, ForceSensor) and wire is not None and (wire.block, wire.port) == port
        one_rate = len(flat.distinct) < 2
        one_way = one_rate and not _passes_by(flat, port, signal.port, ports.plant)
        if at_once and one_way and wire is not None and wire.index is None:
            return signal
        if port[0] in find_upstream(flat, signal.port[0], ports.plant):
            before = find_signal(flat, f"{source.block}.{source.port}")
            model = linearize(diagram, point, inputs=before.name, outputs=signal.name, openings=list(opened), **options)
            model.refuse_delays("a contact")
            leads, unchanged = _follow(model)
            if leads:
                return signal if unchanged and one_way else before
    _refuse_states(flat, ports, signal)
    return signal


def find_sensor(flat: FlatDiagram, path: str) -> str | None:
    """Return the path of the force sensor that a measured force comes from, at once or through blocks with one wire."""
    for _ in flat.table.blocks:
        if isinstance(flat.table.blocks[path], ForceSensor):
            return path
        sources = [
            wire.block
            for port in flat.table.blocks[path].inputs
            if (wire := flat.table.wires.get((path, port))) is not None
        ]
        if len(sources) != 1:
            return None
        path = sources[0]
    return None


def find_upstream(flat: FlatDiagram, path: str, plant: str, *, to_sensors: bool = False) -> set[str]:
    """Return the blocks that lead to a block, itself too, not through the plant, nor ``to_sensors`` through those."""
    found, todo = set[str](), [path]
    while todo:
        here = todo.pop()
        if here in found or here == plant:
            continue
        found.add(here)
        if not (to_sensors and isinstance(flat.table.blocks[here], ForceSensor)):
            todo += [wire.block for (block, _), wire in flat.table.wires.items() if block == here]
    return found


def _passes_by(flat: FlatDiagram, start: tuple[str, str], by: tuple[str, str], plant: str) -> bool:
    """Return whether a signal leads to the plant, not by its own wire there, on a way without another signal."""
    seen, todo = set[tuple[str, str]](), [start]
    while todo:
        here = todo.pop()
        for (path, _), wire in flat.table.wires.items():
            if (wire.block, wire.port) != here:
                continue
            if path == plant:
                if here != start:
                    return True
                continue
            todo += [(path, port) for port in flat.table.blocks[path].outputs if (path, port) not in seen | {by}]
            seen |= {(path, port) for port in flat.table.blocks[path].outputs}
    return False


def _follow(model: Linearization) -> tuple[bool, bool]:
    """Return whether a model's input acts on its output, and whether it arrives there at once and unchanged."""
    size = max(1.0, float(np.max(np.abs(model.D), initial=0.0)))
    B, later = model.B, 0.0
    for _ in range(len(model.A)):
        later = max(later, float(np.max(np.abs(model.C @ B), initial=0.0)))
        B = model.A @ B
        scale = float(np.max(np.abs(B), initial=0.0))
        B = B / scale if scale > 1.0 else B
    at_once = float(np.max(np.abs(model.D), initial=0.0))
    same = model.D.shape[0] == model.D.shape[1] and bool(np.all(np.abs(model.D - np.eye(len(model.D))) <= SAME))
    return max(at_once, later) > SAME * size, same and later <= SAME * size


def _refuse_states(flat: FlatDiagram, ports: Ports, signal: Tap) -> None:
    """Refuse a measured force with states ahead of it: the environment's force would act behind them."""
    for path in sorted(find_upstream(flat, signal.port[0], ports.plant, to_sensors=True)):
        block = flat.table.blocks[path]
        if block.stepped or block.in_model_exchange or (block.states and not block.memory):
            raise OptionError(
                f"found {signal.name!r} behind the states of {path!r} ({type(block).__name__}), to which no wire of "
                f"{ports.plant}.{ports.force} leads: the environment's force would act behind them. Expected the wire "
                "of the force sensor itself: name it, force=…, or wire the force on the plant to the sensor, too. A "
                "force that is estimated from the plant's motion is no sensor: force=None.",
                block=ports.plant,
                port=ports.force,
            )


_EQUAL = 1e-6
"""Relative error of the acceleration in a linear model of differences."""
_NOTHING = 1e-9
"""Slope of the acceleration by a state of the plant that counts as rounding, in 1/s² or 1/s times the velocity's slope.

A robot without friction, stiffness and gravity has none, but for the rounding of terms that cancel. A plant with less
than this moves by itself below 3e-5 rad/s only.
"""


@dataclass(frozen=True)
class Tool:
    """Tool beyond the force sensor of a contact."""

    sensor: str | None = None  # path of the force sensor; None without one
    mass: float = 0.0  # in kg
    problem: str = ""  # reason why the loop with another tool is not known; "" if it is

    def check(self) -> None:
        """Refuse another tool where a model and a run would be different loops."""
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

    ``linear`` makes the linear model from wires to the plant's inputs, with the plant's outputs opened.
    """
    if signal is None or entry is None or signal.port[0] == ports.plant:
        return Tool()
    blocks = flat.table.blocks
    path = find_sensor(flat, signal.port[0])
    if path is None:
        to_plant = {
            p
            for (b, _), wire in flat.table.wires.items()
            if b == ports.plant
            for p in find_upstream(flat, wire.block, ports.plant)
        }
        ahead = find_upstream(flat, signal.port[0], ports.plant)
        found = sorted(
            p
            for p, block in blocks.items()
            if isinstance(block, ForceSensor)
            and (p in ahead or (p in to_plant and entry.port[0] in find_upstream(flat, p, ports.plant)))
        )
        if len(found) > 1:
            names = ", ".join(map(repr, found))
            return Tool(
                problem=f"found the force sensors {names} on the ways of {signal.name!r}; expected one, to "
                f"tell whose tool it is. {_advise(found[0])}"
            )
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
