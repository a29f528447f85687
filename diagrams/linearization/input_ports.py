"""Input ports as places of a linear model: a block that passes the signal on is inserted ahead of the input."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from ...blocks.core import Gain, OptionError, UnknownNameError, elements
from ..flat import FlatDiagram, WiredDiagram
from ..results import OperatingPoint, layout_of
from ..wiring import Wire, join
from .derivatives import find_signal
from .kinks import read_log

D = TypeVar("D", bound=WiredDiagram)
Port = tuple[str, str]


def split_inputs(
    diagram: D, point: OperatingPoint, names: Iterable[str]
) -> tuple[D, OperatingPoint, Mapping[str, str]]:
    """Return the diagram with a block ahead of every input among the names, its operating point, and the blocks' ports.

    Names of wires and outputs are left out: an input has what no signal is called. An injection at a block's port
    reaches that input alone.

    Raises
    ------
    UnknownNameError
        If a name is neither a signal nor an input that is wired.
    """
    found: dict[str, str] = {}
    for name in dict.fromkeys(names):
        flat = diagram.flatten_like(point)
        try:
            find_signal(flat, name)
        except UnknownNameError as error:
            ports = _find_inputs(diagram, name)
            if error.candidates or len(ports) != 1:
                raise
            (port,) = ports
        else:
            continue
        wire = diagram.structure.wires[port]
        signal = find_signal(flat, join(wire.block, wire.port))
        entries = np.array(signal.entries).reshape(flat.checked.shapes[signal.port])
        part = tuple(np.ravel(entries if wire.index is None else entries[wire.index]).tolist())
        diagram, point, found[name] = insert_ahead(diagram, flat, point, [port], signal.port, part)
    return diagram, point, found


def name_inputs(labels: Iterable[str], ports: Mapping[str, str]) -> tuple[str, ...]:
    """Return labels of signals with the names of inputs in place of the inserted blocks' ports.

    Parameters
    ----------
    ports : mapping
        Port of the inserted block, by the input's name.
    """
    names = {port: name for name, port in ports.items()}
    parts = [label.partition("[") for label in labels]
    return tuple(names.get(base, base) + bracket + entry for base, bracket, entry in parts)


def _find_inputs(diagram: WiredDiagram, name: object) -> list[Port]:
    known = {join(*port): port for port in diagram.structure.wires}
    return [port for full, port in known.items() if full == name or full.endswith(f".{name}")]


def insert_ahead(
    diagram: D, flat: FlatDiagram, point: OperatingPoint, inputs: Sequence[Port], source: Port, entries: Sequence[int]
) -> tuple[D, OperatingPoint, str]:
    """Return the diagram with a block ahead of inputs of one source, its operating point, and the block's port.

    Parameters
    ----------
    inputs : sequence of (str, str)
        Block and port of each input, all in one subsystem.
    source : (str, str)
        Port that is wired to them.
    entries : sequence of int
        Its entries that are.
    """
    table = diagram.structure.copy()
    subsystem = table.subsystem_of[inputs[0][0]]
    path = join(subsystem, "_".join(["to", *(f"{b.rpartition('.')[2]}_{p}" for b, p in inputs)]).replace(".", "_"))
    while path in table.blocks:
        path += "_"
    table.blocks[path] = Gain(gain=1.0, name=path.rpartition(".")[2])
    table.subsystem_of[path] = subsystem
    table.wires[path, "u"] = table.wires[inputs[0]]
    for each in inputs:
        table.wires[each] = Wire(path, "y")
        table.handed.pop(each, None)
    split = diagram.with_structure(table)
    value = read_log(flat, point)[flat.log.slices[join(*source)]][list(entries)]
    return split, _carry_point(flat, split.flatten_like(point), point, path, value), f"{path}.y"


def _carry_point(
    flat: FlatDiagram, split: FlatDiagram, point: OperatingPoint, path: str, value: np.ndarray
) -> OperatingPoint:
    """Return the operating point of the diagram with the inserted block, which passes on ``value``."""
    known = dict(zip(flat.labels, point.x, strict=True))
    labels = elements(f"{path}.y", split.checked.shapes[path, "y"])
    own = {f"{kind}({label})": v for kind in ("held", "loop") for label, v in zip(labels, value, strict=True)}
    missing = [label for label in split.labels if label not in known and label not in own]
    if missing or len(known) + sum(label in own for label in split.labels) != split.width:
        raise OptionError(
            f"found other signals in the state where the wire is split ({', '.join(missing) or 'fewer'}), as of a "
            "solved algebraic loop; expected those of the operating point. Cut the whole wire.",
            block=path,
            port="to",
        )
    x = np.array([known[label] if label in known else own[label] for label in split.labels])
    return replace(point, x=x, layout=layout_of(split))
