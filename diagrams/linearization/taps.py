"""Taps: ports of a diagram, or entries of them, at which signals are injected, measured or cut."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...blocks.core import UnknownNameError, elements, near
from ..flat import FlatDiagram
from ..results import explain_input, resolve
from ..wiring import Wire, explain_absent_state, index_of, split_entry


@dataclass(frozen=True)
class Tap:
    """A tap: an output port of a diagram, or entries of it."""

    name: str
    port: tuple[str, str]  # path of the block, and name of its port
    entries: tuple[int, ...]  # numbers of the entries in the flat port
    labels: tuple[str, ...]
    entry: tuple[int, ...] = ()  # numbers of the entry that the name asks for, counted from 1; () for the whole


def wire_entries(flat: FlatDiagram, wire: Wire) -> tuple[int, ...]:
    """Return the numbers of the entries of a port that a wire takes."""
    return tuple(np.ravel(wire.entries(flat.checked.shapes[wire.block, wire.port])).tolist())


def find_signal(flat: FlatDiagram, name: str) -> Tap:
    """Return the port, or entries of one, that a name of a wire or port denotes."""
    wires, ports = flat.table.names, flat.log.slices
    if not isinstance(name, str):
        raise UnknownNameError(f"found {name!r}; expected the name of a wire, or the path of a port. Give a text.")
    name, entry = split_entry(name, {*wires, *ports})
    try:
        full = resolve(name, wires, ports, flat.table.blocks)
    except UnknownNameError as error:
        if error.candidates:
            raise
        known = {n.rpartition(".")[2] for n in (*wires, *ports)} | {*wires, *ports}
        reason = explain_absent_state(flat.table.blocks, name)
        reason = reason or explain_input(flat.table.blocks, name, flat.table.wires)
        step = f"{reason[0].upper()}{reason[1:]}" if reason else near(name, known)
        raise UnknownNameError(f"there is no signal {name!r} in this diagram. {step}") from None
    wire = wires[full] if full in wires else Wire(*flat.ports[full])
    part = wire.entries(flat.checked.shapes[wire.block, wire.port])
    labels = np.array(elements(name if name in wires else full, part.shape)).reshape(part.shape)
    if entry:
        index_of_entry = index_of(entry, part.shape, full)
        part, labels = part[index_of_entry], labels[index_of_entry]
    flat_labels = tuple(str(e) for e in np.ravel(labels))
    return Tap(name, (wire.block, wire.port), tuple(np.ravel(part).tolist()), flat_labels, entry)
