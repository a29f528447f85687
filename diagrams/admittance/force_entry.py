"""The place where the environment's force enters the rest of a diagram.

The diagram's own force on the plant comes by the wire of the force port, if there is one. The measured force is another
wire, behind the force sensor. Where the first leads to the second at once and unchanged, the environment's force is
added to the second. Where a delay, a filter, a gain or a slower clock lies between them, where the first leads to the
plant's other inputs on ways of its own, too, and where both are one wire, it is added to the first, for all its readers
but the plant: so it takes those ways, too.

Without a way between the two, nothing tells the sensor from what follows it, and a measured wire behind states is
refused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ...blocks import ForceSensor
from ...blocks.core import OptionError
from ..linearization import Linearization, Tap, find_signal, linearize
from .contact_ports import Ports, Source

if TYPE_CHECKING:
    from ..flat import FlatDiagram, WiredDiagram
    from ..results import OperatingPoint

SAME = 1e-9
"""Relative size of an entry that should be zero."""


def find_entry(
    diagram: WiredDiagram,
    point: OperatingPoint,
    ports: Ports,
    signal: Tap,
    wires: Mapping[str, Source],
    opened: Sequence[str],
    options: Mapping[str, Any],
) -> Tap:
    """Return the wire to which the environment's force is added.

    Parameters
    ----------
    diagram, point
        Diagram, and its operating point.
    ports : Ports
        Plant and its ports.
    signal : Tap
        Measured force.
    wires : mapping
        Sources of the plant's inputs.
    opened : sequence of str
        Outputs of the plant that are used.
    options : mapping
        Options of the linear model.

    Raises
    ------
    OptionError
        If the measured force lies behind states, and the wire of the force port does not lead there.
    """
    flat, source = diagram.flatten_like(point), wires.get(ports.force)
    if source is not None and (source.block, source.port) == signal.port:
        return find_signal(flat, signal.name)  # measured ahead of what is added: the plant has that already
    if source is not None and source.part is None:
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
        sources = [wire.block for port in flat.table.blocks[path].inputs
                   if (wire := flat.table.wires.get((path, port))) is not None]  # fmt: skip
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
        if block.stepped or block.evaluated_outside or (block.states and not block.memory):
            raise OptionError(
                f"found {signal.name!r} behind the states of {path!r} ({type(block).__name__}), to which no wire of "
                f"{ports.plant}.{ports.force} leads: the environment's force would act behind them. Expected the wire "
                "of the force sensor itself: name it, force=…, or wire the force on the plant to the sensor, too. A "
                "force that is estimated from the plant's motion is no sensor: force=None.",
                block=ports.plant,
                port=ports.force,
            )
