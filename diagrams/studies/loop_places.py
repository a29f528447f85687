"""Loops of a study: the places at which they are cut, and their numbers.

Places are wires behind their sources, or ahead of some of their consumers.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...blocks.core import LoopwrightError, OptionError
from ..flat import FlatDiagram, WiredDiagram
from ..frequency import Number, margins, mimo_disk_margin, scan_margins
from ..linearization import Linearization, find_inputs, find_signal, find_ways_back, name_of_cut, name_wire_to
from ..requirements import SENSES, Requirements, Sense
from ..wiring import join

OtherCuts = tuple[tuple[str, tuple[str, ...]], ...]
"""Wires and inputs of cuts, as of `Linearization.loop`."""
NOTHING = 1e-12
"""Size of a loop that is zero but for rounding."""
STEP = 1e-3
"""Communication step in s with which signals of a diagram without a clock are looked up."""


@dataclass(frozen=True)
class LoopPlace:
    """The place at which a report cuts a loop."""

    wire: str
    to: tuple[tuple[str, str], ...] = ()  # block and port of the inputs ahead of which it is cut; () for all consumers
    own: tuple[tuple[str, str], ...] = ()  # other consumers, by which the controller comes back to itself
    at: str = ""  # wire behind this one that feeds these inputs, if it is another
    others: OtherCuts = ()  # of the loop, where several blocks may be the plant

    @property
    def name(self) -> str:
        """Name of the wire that is cut, in diagrams of `cut_places`: "u → plant.u" ahead of some consumers."""
        return name_of_cut(self.at or self.wire, self.to)


def find_places(diagram: WiredDiagram, wires: Mapping[str, str], asked: Requirements | None) -> dict[str, LoopPlace]:
    """Return the places at which loops at wires are cut, by the keys of these.

    They are those that requirements name. Else a wire that also feeds a model of the controller's own is cut ahead of
    the plant, and any other behind its source.
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
    """Return the place ahead of the plant's inputs, where they can be found and all take the whole wire."""
    tap, wires = find_signal(flat, wire), diagram.structure.wires
    ways = find_ways_back(flat, tap.port)

    def is_whole(inputs: Iterable[tuple[str, str]]) -> bool:
        return not tap.entry and all(wires[to].index is None for to in inputs if to in wires)

    def others(of: str) -> OtherCuts:
        at = {tap.port: wire, ways.port: of}
        cuts = [cut for cut in ways.others if is_whole(cut.to)]
        return tuple((at.get(cut.port, join(*cut.port)), tuple(join(*to) for to in cut.to)) for cut in cuts)

    if not ways.own or not ways.is_separable or not is_whole((*ways.plant, *ways.own)):
        return LoopPlace(wire, others=others(wire))
    place = LoopPlace(wire, ways.plant, ways.own, "" if ways.port == tap.port else join(*ways.port))
    try:
        cut_places(diagram, [place])
    except LoopwrightError:  # its inputs are in several subsystems
        return LoopPlace(wire)
    return replace(place, others=others(place.name))


def place_loops(
    diagram: WiredDiagram,
    loops: str | Iterable[str] | None,
    requirements: Requirements | None,
    to: str | Iterable[str] | None = None,
) -> tuple[WiredDiagram, list[str], Requirements | None, dict[str, OtherCuts]]:
    """Return a diagram with loops at wires, and requirements on them, in which the places of these loops have names.

    The last entry has the other cuts of each loop by its name, where several blocks may be the plant.

    Places are those that requirements name, or ``to`` of a single wire: inputs of blocks, none for all consumers. Else
    a wire that also feeds a model of the controller's own is cut ahead of the plant, unless it is cut together with
    other wires.
    """
    wires = [loops] if isinstance(loops, str) else list(loops or ())
    if to is not None and (requirements is not None or len(wires) != 1):
        found = "requirements" if requirements is not None else f"{len(wires)} wires"
        raise OptionError(
            f"found it with {found}; expected it for one wire. Give one, loop='u', or write it into the requirements: "
            "loops={'u': {'to': 'plant.u'}}.",
            block=diagram.name,
            port="to",
        )
    if requirements is None and len(wires) != 1:
        return diagram, wires, None, {}
    if to is not None:
        inputs = (to,) if isinstance(to, str) else tuple(to)
        flat = diagram.flatten(None if diagram.has_clock else STEP)
        places = {wires[0]: LoopPlace(wires[0], tuple(find_inputs(diagram, flat, wires[0], inputs)))}
    else:
        every = dict.fromkeys([*wires, *(requirements.loops if requirements is not None else ())])
        asked = [w for w in every if requirements is not None and requirements.inputs_of((w,)) is not None]
        places = find_places(diagram, {wire: wire for wire in asked}, requirements)
        flat = diagram.flatten(None if diagram.has_clock else STEP)
        for wire in every:
            if wire not in places:
                with suppress(LoopwrightError):  # an unknown wire is refused where its loop is made
                    places[wire] = _place_at_plant(diagram, wire, flat)
    names = {wire: place.name for wire, place in places.items()}
    diagram = cut_places(diagram, tuple(places.values()))
    renamed = None if requirements is None else requirements.with_loops(names)
    others = {place.name: place.others for place in places.values() if place.others}
    return diagram, [names.get(wire, wire) for wire in wires], renamed, others


def numbers_at_other_cuts(model: Linearization, others: OtherCuts, delay: int = 0) -> dict[str, dict[str, Number]]:
    """Return the numbers of a loop at other cuts by their inputs, {} where it has none; zero loops are left out."""
    found: dict[str, dict[str, Number]] = {}
    for wire, inputs in others:
        try:
            L = model.loop(wire, to=inputs)
            if not is_zero(L):
                found[words_of(inputs)] = numbers_of(L, delay)
        except LoopwrightError:
            found[words_of(inputs)] = {}
    return found


def is_zero(L: Any) -> bool:
    """Whether a loop is zero but for rounding."""
    points = np.exp(1j * np.geomspace(1e-3, 3.0, 9)) if L.dt else 1j * np.geomspace(1e-3, 1e3, 9)
    return bool(np.max(np.abs(L(points))) <= NOTHING)


def words_of(inputs: Sequence[str]) -> str:
    """Return the inputs ahead of which a wire is cut in words."""
    return " and ".join(inputs) or "all of them"


def cut_places(diagram: WiredDiagram, places: Sequence[LoopPlace]) -> WiredDiagram:
    """Return the diagram in which the wires at some places have names."""
    for place in places:
        if place.to:
            diagram = name_wire_to(diagram, place.name, place.to)
    return diagram


def numbers_of(L: Any, delay: int = 0, skew: float = 0.0) -> dict[str, Number]:
    """Return the numbers of a loop by name; of one with several channels the disk margin."""
    if L.ninputs > 1:
        return {"disk_margin": mimo_disk_margin(L, delay=delay, skew=skew).alpha}
    return margins(L, delay=delay, skew=skew).numbers()


def compared_numbers(L: Any, names: Iterable[str], delay: int = 0, skew: float = 0.0) -> dict[str, float]:
    """Return some numbers of a loop that are only compared with confirmed ones; NaN where the loop is unstable.

    Nothing confirms them, which takes most of the time of `numbers_of`, where a scan of the response has them all.
    """
    names = list(names)
    if L.ninputs > 1 or any(name.startswith("delay_margin") for name in names):
        found = {name: number.value for name, number in numbers_of(L, delay, skew).items()}
    else:
        found = scan_margins(L, delay=delay, skew=skew)
    return {name: found.get(name, math.nan) for name in names}


def write_open_loop(wire: str, quantity: str, at: object = None) -> str:
    """Return how a number of a loop with slower subsystems held is written as a function for ``quantity``.

    A function's value is the worse, the smaller it is: a number that is the worse, the larger, has its sign changed.
    """
    sign, point = "-" if SENSES[quantity] is Sense.MOST else "", "" if at is None else "at=…"
    return f'lambda d: {sign}margins(d.linearize({point}).loop("{wire}", slow="open")).{quantity}.value'
