"""Wires of a drawing, subsystem by subsystem: each leads from its block across borders to its consumers."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from ..wiring import Structure, Wire
from .layers import Pin


class Border(Enum):
    """The inner side of a subsystem's border, where its wires begin and end."""

    INPUTS = "inputs"
    """Signals enter the subsystem there."""
    OUTPUTS = "outputs"
    """Signals leave the subsystem there."""


class PinPlace(NamedTuple):
    """An end of a wire inside a subsystem: at a block, at an inner subsystem, or at the subsystem's own border."""

    path: str
    border: Border | None = None  # the side of the border; None at a block or an inner subsystem

    def key(self, pin: Pin) -> str:
        """Return the key of the node at this place: on a border every pin is its own node."""
        return self.path if self.border is None else f"{self.border.value} of {self.path}: {pin.maker} {pin.port}"


PlacedPin = tuple[PinPlace, Pin]


class Nets:
    """All wires of a diagram by subsystem.

    Attributes
    ----------
    of : dict
        For each subsystem the sources inside, each with all its sinks there.
    parts : dict
        The part of its signal that a wire leads, such as "[1]", by the path and pin at which it ends.
    ins, outs : dict
        Pins of every block and subsystem.
    names : dict
        Names of the wires that begin at a block's port.
    """

    def __init__(self, table: Structure):
        self.table = table
        self.of: dict[str, dict[PlacedPin, list[PlacedPin]]] = {path: {} for path in table.subsystems}
        self.parts: dict[tuple[str, Pin], str] = {}
        self.ins: dict[str, list[Pin]] = {}
        self.outs: dict[str, list[Pin]] = {}
        self.names: dict[tuple[str, str], list[str]] = {}
        for name, wire in table.names.items():
            short = name.rpartition(".")[2]
            if short not in self.names.setdefault((wire.block, wire.port), []):
                self.names[wire.block, wire.port].append(short)
        for (path, port), wire in table.wires.items():
            self._thread(wire, table.subsystem_of[path], path, Pin(port))
        for path, wire in table.controls.items():
            self._thread(wire, path.rpartition(".")[0], path, Pin(wire.port, wire.block, control=True))
        for block, port in self.names:
            self.of[table.subsystem_of[block]].setdefault((PinPlace(block), Pin(port)), [])
            _add(self.outs, block, Pin(port))

    def name_of(self, path: str, pin: Pin) -> str:
        """Return the names of the wire that begins at a pin of a block or a subsystem."""
        block = path if path in self.table.blocks else pin.maker
        return ", ".join(self.names.get((block, pin.port), []))

    def label_at(self, place: PinPlace, pin: Pin, sinks: list[PlacedPin]) -> str:
        """Return the text at a wire's source: its name; empty where the wire only leaves the subsystem."""
        if place.border is Border.INPUTS or (sinks and all(end.border is Border.OUTPUTS for end, _ in sinks)):
            return ""
        return self.name_of(place.path, pin)

    def is_part(self, place: PinPlace, pin: Pin) -> bool:
        """Whether only a part of the wire's signal goes into this end."""
        return place.border is None and (place.path, pin) in self.parts

    def _thread(self, wire: Wire, subsystem: str, item: str, pin: Pin) -> None:
        """Lead a wire from its block across borders to a consumer in a subsystem."""
        crossing = Pin(wire.port, wire.block)
        here = self.table.subsystem_of[wire.block]
        end = (PinPlace(wire.block), Pin(wire.port))
        _add(self.outs, wire.block, end[1])
        while not (here == subsystem or not here or subsystem.startswith(here + ".")):
            self._join(here, end, (PinPlace(here, Border.OUTPUTS), crossing))
            _add(self.outs, here, crossing)
            end, here = (PinPlace(here), crossing), here.rpartition(".")[0]
        for inner in _subsystems_between(here, subsystem):
            self._join(here, end, (PinPlace(inner), crossing))
            _add(self.ins, inner, crossing)
            end, here = (PinPlace(inner, Border.INPUTS), crossing), inner
        self._join(here, end, (PinPlace(item), pin))
        _add(self.ins, item, pin)
        if wire.index is not None:
            self.parts[item, pin] = wire.part

    def _join(self, subsystem: str, source: PlacedPin, sink: PlacedPin) -> None:
        sinks = self.of[subsystem].setdefault(source, [])
        if sink not in sinks:
            sinks.append(sink)


def _subsystems_between(outer: str, inner: str) -> list[str]:
    """Return the paths of the subsystems from one down to another inside it, without the outer one."""
    parts = inner.split(".") if inner else []
    start = len(outer.split(".")) if outer else 0
    return [".".join(parts[: i + 1]) for i in range(start, len(parts))]


def _add(pins: dict[str, list[Pin]], item: str, pin: Pin) -> None:
    if pin not in pins.setdefault(item, []):
        pins[item].append(pin)
