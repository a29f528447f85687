"""Places at which loops are cut: wires behind their sources, or ahead of some of their consumers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from ...blocks.core import LoopwrightError
from ..flat import FlatDiagram, WiredDiagram
from ..linearization import find_inputs, find_signal, find_ways_back, name_wire_to
from ..requirements import Requirements
from ..wiring import join

STEP = 1e-3
"""Communication step in s with which signals of a diagram without a clock are looked up."""


@dataclass(frozen=True)
class LoopPlace:
    """The place at which a report cuts a loop.

    Attributes
    ----------
    wire : str
        Name of the wire.
    to : tuple of (str, str)
        Block and port of the inputs ahead of which it is cut; empty for all consumers.
    own : tuple of (str, str)
        Other consumers, by which the controller comes back to itself.
    """

    wire: str
    to: tuple[tuple[str, str], ...] = ()
    own: tuple[tuple[str, str], ...] = ()

    @property
    def name(self) -> str:
        """Name of the wire that is cut, in diagrams of `cut_places`: "u → plant.u" ahead of some consumers."""
        return f"{self.wire} → {', '.join(join(*to) for to in self.to)}" if self.to else self.wire


def find_places(diagram: WiredDiagram, wires: Mapping[str, str], asked: Requirements | None) -> dict[str, LoopPlace]:
    """Return the places at which loops at wires are cut, by the keys of these.

    They are those that requirements name. Else a wire that also feeds a model of the controller's own is cut ahead of
    the plant, and any other behind its source.

    Raises
    ------
    UnknownNameError, WiringError
        If the inputs of a requirement are none of the wire.
    """
    found: dict[str, LoopPlace] = {}
    flat = diagram.flatten(None if diagram.has_clock else STEP)
    for key, wire in wires.items():
        given = None if asked is None else asked.inputs_of((key, wire))
        if asked is not None and given is not None:
            try:
                found[key] = LoopPlace(wire, tuple(find_inputs(diagram, flat, wire, given)))
                cut_places(diagram, [found[key]])
            except LoopwrightError as error:
                name = key if key in asked.loops else wire
                raise asked.error_at(error, f"loops.{name}.to") from None
        else:
            found[key] = _place_at_plant(diagram, wire, flat)
    return found


def _place_at_plant(diagram: WiredDiagram, wire: str, flat: FlatDiagram) -> LoopPlace:
    """Return the place ahead of the plant's inputs, where they can be told from others and all take the whole wire."""
    tap, wires = find_signal(flat, wire), diagram.structure.wires
    ways = find_ways_back(flat, tap.port)
    is_whole = not tap.entry and all(wires[to].index is None for to in (*ways.plant, *ways.own) if to in wires)
    if not ways.own or not is_whole:
        return LoopPlace(wire)
    place = LoopPlace(wire, ways.plant, ways.own)
    try:
        cut_places(diagram, [place])
    except LoopwrightError:  # its inputs are in several subsystems
        return LoopPlace(wire)
    return place


def place_loops(
    diagram: WiredDiagram, loops: str | Iterable[str] | None, requirements: Requirements
) -> tuple[WiredDiagram, list[str], Requirements]:
    """Return a diagram with loops at wires, and requirements on them, in which places that are required have names.

    Raises
    ------
    UnknownNameError, WiringError
        If the inputs of a requirement are none of the wire.
    """
    wires = [loops] if isinstance(loops, str) else list(loops or ())
    every = dict.fromkeys([*wires, *requirements.loops])
    asked = {wire: wire for wire in every if requirements.inputs_of((wire,))}
    places = find_places(diagram, asked, requirements)
    names = {wire: place.name for wire, place in places.items()}
    diagram = cut_places(diagram, tuple(places.values()))
    return diagram, [names.get(wire, wire) for wire in wires], requirements.with_loops(names)


def cut_places(diagram: WiredDiagram, places: Sequence[LoopPlace]) -> WiredDiagram:
    """Return the diagram in which the wires at some places have names."""
    for place in places:
        if place.to:
            diagram = name_wire_to(diagram, place.name, place.to)
    return diagram
