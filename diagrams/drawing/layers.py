"""Layers of a drawing: wires that close loops, positions in a layer, and heights."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple

from ..wiring import find_cyclic_parts


class Pin(NamedTuple):
    """A pin of a block, by its port, or of a subsystem, by the output that makes the signal."""

    port: str  # at a subsystem, that of the maker
    maker: str = ""  # at a subsystem, the path of the block that makes the signal
    control: bool = False  # it enables or triggers the subsystem


@dataclass(eq=False)
class Node:
    """A block, a subsystem, a pin on a subsystem's border, or a wire on its way through a layer."""

    key: str
    width: float
    height: float
    ins: dict[Pin, float] = field(default_factory=dict)  # height of every pin below the upper edge
    outs: dict[Pin, float] = field(default_factory=dict)
    side: int = 0  # -1 for an input pin of the subsystem whose inside is laid out, 1 for an output pin
    plant: bool = False  # loops are closed behind it
    controller: int | None = None  # rank among the nodes ahead of which loops are closed
    lane: bool = False  # it is a wire on its way through a layer
    loose: bool = False  # it has no inputs, or is a wire from such a node
    layer: int = 0
    x: float = 0.0
    y: float = 0.0


Link = tuple[Node, float, Node, float]
"""A wire between neighbouring layers: node, height of its pin, node, height of its pin."""

# --- loops ----------------------------------------------------------------------------------------------------------


def cut_loops(
    keys: Sequence[str],
    pairs: Iterable[tuple[str, str]],
    plants: set[str],
    controllers: Mapping[str, int] = MappingProxyType({}),
) -> list[tuple[str, str]]:
    """Return the wires that close no loop.

    Loops are closed behind ``plants``. What is between one and a controller, such as the integrator of a speed, stays
    on its right: such a loop is closed ahead of the controller. Others are closed ahead of ``controllers``, so that a
    plant is on the right of them: of the lowest rank, and of these one that the loop is entered at: in a cascade the
    outermost one, which has the reference. Without any it is the node at which the loop is entered.
    """
    left = [pair for pair in dict.fromkeys(pairs) if pair[0] != pair[1]]
    place = {key: i for i, key in enumerate(keys)}
    while True:
        knots = find_cyclic_parts(keys, left)
        if not knots:
            return left
        gone: set[tuple[str, str]] = set()
        for knot in knots:
            plant = min(knot & plants, key=place.__getitem__, default=None)
            behind = {b for a, b in left if a == plant and b in knot}
            behind = behind & controllers.keys() if knot & controllers.keys() else behind
            if behind and not plants >= knot:
                gone |= {(plant, b) for b in behind if plant is not None}
            else:
                entered = {b for a, b in left if b in knot and a not in knot}
                known = [key for key in (*entered, *knot) if key in controllers]
                door = min(
                    known or entered or knot,
                    key=lambda key: (controllers.get(key, 0), key not in entered, place[key]),
                )
                gone |= {(a, b) for a, b in left if b == door and a in knot}
        left = [pair for pair in left if pair not in gone]


# --- positions in a layer -------------------------------------------------------------------------------------------


def order_layers(layers: list[list[Node]], links: Sequence[Link]) -> list[list[Node]]:
    """Sort every layer so that few wires cross: sweep to the barycentres of the neighbours, and keep the best order."""
    left, right = _neighbours(links)
    best, least = layers, _count_crossings(layers, links)
    now = [list(layer) for layer in layers]
    for sweep in range(24):
        if not least:
            break
        forth = sweep % 2 == 0
        sides = left if forth else right
        spot = _spots(now)
        for layer in now if forth else reversed(now):
            centre = {}
            for i, node in enumerate(layer):
                around = [spot[id(other)] + dy / (other.height + 1) for other, dy, _ in sides.get(id(node), [])]
                centre[id(node)] = sum(around) / len(around) if around else float(i)
            layer.sort(key=lambda node: centre[id(node)])
            spot.update({id(node): float(i) for i, node in enumerate(layer)})
        crossings = _count_crossings(now, links)
        if crossings < least:
            best, least = [list(layer) for layer in now], crossings
    return _swap_neighbours(best, links, least)


def _swap_neighbours(layers: list[list[Node]], links: Sequence[Link], least: int) -> list[list[Node]]:
    """Exchange neighbours in a layer as long as that removes crossings."""
    layers = [list(layer) for layer in layers]
    if sum(map(len, layers)) > 150:
        return layers
    for _ in range(4):
        start = least
        for layer in layers:
            near = [k for k in links if k[0] in layer or k[2] in layer]
            here = _count_crossings(layers, near)
            for i in range(len(layer) - 1):
                layer[i], layer[i + 1] = layer[i + 1], layer[i]
                crossings = _count_crossings(layers, near)
                if crossings < here:
                    least, here = least - (here - crossings), crossings
                else:
                    layer[i], layer[i + 1] = layer[i + 1], layer[i]
        if least == start:
            break
    return layers


def _spots(layers: list[list[Node]]) -> dict[int, float]:
    return {id(node): float(i) for layer in layers for i, node in enumerate(layer)}


def _neighbours(links: Sequence[Link]) -> tuple[dict[int, list[tuple[Node, float, float]]], ...]:
    """Return, for every node, its neighbours on the left and on the right with both pins' heights."""
    left: dict[int, list[tuple[Node, float, float]]] = {}
    right: dict[int, list[tuple[Node, float, float]]] = {}
    for a, da, b, db in links:
        left.setdefault(id(b), []).append((a, da, db))
        right.setdefault(id(a), []).append((b, db, da))
    return left, right


def _count_crossings(layers: list[list[Node]], links: Sequence[Link]) -> int:
    spot = _spots(layers)
    channels: dict[int, list[tuple[tuple[float, float], tuple[float, float]]]] = {}
    for a, da, b, db in links:
        channels.setdefault(a.layer, []).append(((spot[id(a)], da), (spot[id(b)], db)))
    return sum(
        (first[0] < second[0] and first[1] > second[1]) or (first[0] > second[0] and first[1] < second[1])
        for wires in channels.values()
        for i, first in enumerate(wires)
        for second in wires[i + 1 :]
    )


# --- heights --------------------------------------------------------------------------------------------------------


def place_layers(layers: list[list[Node]], links: Sequence[Link], *, gap: Callable[[Node, Node], float]) -> None:
    """Set ``y`` of all nodes so that wires are straight where they can be; ``gap(upper, lower)`` is room between."""
    left, right = _neighbours(links)
    for layer in layers:
        y = 0.0
        for i, node in enumerate(layer):
            y += gap(layer[i - 1], node) if i else 0.0
            node.y, y = y, y + node.height
    sweeps = [(layers, left), (layers[::-1], right)] * 4 + [(layers, left), (layers, None)]
    for row, sides in sweeps:
        for layer in row:
            wanted = []
            for node in layer:
                sets = [sides] if sides is not None else [left, right]
                pulls = [
                    (other.y + there - here, _stiffness(node, other))
                    for side in sets
                    for other, there, here in side.get(id(node), [])
                ]
                wanted.append((_median(pulls), sum(w for _, w in pulls)) if pulls else (node.y, 0.1))
            _settle(layer, wanted, gap)
    _close_up([node for layer in layers for node in layer], gap)


def _close_up(nodes: Sequence[Node], gap: Callable[[Node, Node], float]) -> None:
    """Shift nodes up where a band across the whole drawing is empty, and round their heights."""
    lowest: Node | None = None
    shift = 0.0
    for node in sorted(nodes, key=lambda node: node.y):
        if lowest is None:
            shift = node.y
        else:
            shift += max(node.y - shift - (lowest.y + lowest.height) - gap(lowest, node), 0.0)
        node.y = round(node.y - shift)
        if lowest is None or node.y + node.height > lowest.y + lowest.height:
            lowest = node


def _stiffness(a: Node, b: Node) -> float:
    """Return the weight of a straight wire between two nodes."""
    if a.lane and b.lane:
        return 4.0
    if a.loose or b.loose:  # a source can be anywhere
        return 0.5
    return 2.0 if a.lane or b.lane else 1.5


def _median(values: Sequence[tuple[float, float]]) -> float:
    """Return the weighted median; of two in the middle the first."""
    half, total = sum(w for _, w in values) / 2, 0.0
    for value, weight in sorted(values):
        total += weight
        if total >= half:
            return value
    return values[-1][0]


def _settle(layer: list[Node], wanted: list[tuple[float, float]], gap: Callable[[Node, Node], float]) -> None:
    """Move the nodes of a layer as near to their wanted heights as they can come, in order and apart."""
    offsets, total = [], 0.0
    for i, node in enumerate(layer):
        total += layer[i - 1].height + gap(layer[i - 1], node) if i else 0.0
        offsets.append(total)
    groups: list[list[tuple[float, float]]] = []
    for (value, weight), offset in zip(wanted, offsets, strict=True):
        groups.append([(value - offset, weight)])
        while len(groups) > 1 and _median(groups[-2]) > _median(groups[-1]):
            groups[-2:] = [groups[-2] + groups[-1]]
    heights = [_median(group) for group in groups for _ in group]
    for node, height, offset in zip(layer, heights, offsets, strict=True):
        node.y = height + offset
