"""Rows of a drawing: what is wider than the page is broken into rows, which are read like lines of text.

Every row is laid out by itself. A wire to another row leaves its row on the right, runs back to the left in the strip
below the row, and enters the other row on the left. A pin on the border of a subsystem is in the row of its block.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from .drawing_layout import GAP, LANE, TRACK, Net, arrange
from .layers import Node, Pin

SLACK = 1.2
"""Factor by which a drawing may be wider than asked for: a page shows it that much smaller."""

ROW_COST = 6.0
"""Number of wires between rows that one row less is worth."""

_PIN = Pin("")


@dataclass(eq=False)
class _Row:
    """A row in the making: its nodes and wires, the wires' ends at its sides, and its place."""

    nodes: list[Node] = field(default_factory=list)
    nets: list[tuple[Net, Net]] = field(default_factory=list)
    """Whole nets, each with its part in this row."""
    entries: dict[str, Node] = field(default_factory=dict)
    exits: dict[str, Node] = field(default_factory=dict)
    y: float = 0.0
    width: float = 0.0
    height: float = 0.0

    def enter(self, net: Net) -> Node:
        return self.entries.setdefault(net.key, Node(f"entry of {net.key}", 0.0, 0.0, {}, {_PIN: 0.0}, -1))

    def leave(self, net: Net) -> Node:
        return self.exits.setdefault(net.key, Node(f"exit of {net.key}", 0.0, 0.0, {_PIN: 0.0}, {}, 1))


def arrange_in_rows(nodes: Sequence[Node], nets: Sequence[Net], limit: float) -> tuple[float, float]:
    """Place nodes and route nets, in place, in rows; return the width and height.

    It is one row up to a width of ``limit`` pixels. A single layer can be wider.
    """
    size = arrange(nodes, nets)
    inner = [node for node in nodes if not node.side]
    if size[0] <= SLACK * limit or not inner:
        return size
    row_of, wider = (_find_rows(inner, nets, width) for width in (limit, (1.0 + SLACK) / 2 * limit))
    if max(wider.values()) < max(row_of.values()):
        row_of = wider
    if not any(row_of.values()):
        return size
    for net in nets:
        net.runs, net.dots, net.below = [], [], 0.0
    return _stack(nodes, nets, row_of)


def _find_rows(nodes: Sequence[Node], nets: Sequence[Net], limit: float) -> dict[str, int]:
    """Return the row of each node: layers side by side, no wider than the limit, with few wires between rows."""
    layers = sorted({node.layer for node in nodes})
    begin = [min(n.x for n in nodes if n.layer == layer) for layer in layers]
    end = [max(n.x + n.width for n in nodes if n.layer == layer) for layer in layers]
    layer_of = {node.key: node.layer for node in nodes}
    spans = []
    for net in nets:
        known = [layer_of[key] for key, _ in (net.source, *net.sinks) if key in layer_of]
        if len(known) > 1:
            spans.append((min(known), max(known)))
    cost = [sum(low < layer <= high for low, high in spans) for layer in layers]  # of a row that begins here
    room = limit - 4 * LANE - 6 * TRACK
    best: list[tuple[float, int]] = [(0.0, 0)]  # of the layers so far: cost, and where the last row begins
    for last in range(len(layers)):
        ways = [
            (best[first][0] + cost[first] + ROW_COST, first)
            for first in range(last, -1, -1)
            if first == last or end[last] - begin[first] <= room
        ]
        best.append(min(ways, key=lambda way: (way[0], -way[1])))  # of equal ways the one with long rows ahead
    starts, last = [], len(layers)
    while last:
        last = best[last][1]
        starts.append(last)
    starts.reverse()
    return {n.key: sum(layers.index(n.layer) >= start for start in starts) - 1 for n in nodes}


class _Crossing(NamedTuple):
    """A net between rows."""

    net: Net
    home: _Row | None  # the row that it leaves; None if its source is on the border
    others: list[_Row]  # those that it enters


class _BorderPin(NamedTuple):
    """A pin on the border of the subsystem whose inside is laid out, and where its net ends in a row."""

    node: Node
    row: _Row
    net: Net

    @property
    def end(self) -> Node:
        ends = self.row.entries if self.node.side < 0 else self.row.exits
        return ends[self.net.key]


def _stack(nodes: Sequence[Node], nets: Sequence[Net], row_of: dict[str, int]) -> tuple[float, float]:
    """Lay out rows one below the other, and join what is wired between them; return the width and height."""
    rows, crossing, pins = _split(nodes, nets, row_of)
    left = (len(crossing) - 1) * TRACK + 2 * LANE if crossing else 0.0
    _place(rows, crossing)
    for row in rows:
        for node in (*row.nodes, *row.entries.values(), *row.exits.values()):
            node.x, node.y = node.x + left, node.y + row.y
        for net, part in row.nets:
            net.runs += [[(x + left, y + row.y) for x, y in run] for run in part.runs]
            net.dots += [(x + left, y + row.y) for x, y in part.dots]
    _connect(crossing, left, {id(pin.net) for pin in pins})
    width = max([left + row.width for row in rows] + [x for net in nets for run in net.runs for x, _ in run])
    _join_border(nodes, pins, width)
    if any(node.side > 0 for node in nodes):
        width += LANE
    return width, rows[-1].y + rows[-1].height + _strip(rows[-1], crossing)


def _split(
    nodes: Sequence[Node], nets: Sequence[Net], row_of: dict[str, int]
) -> tuple[list[_Row], list[_Crossing], list[_BorderPin]]:
    """Return the rows with their nodes and parts of nets, the nets between rows, and the pins on the border."""
    by_key = {node.key: node for node in nodes}
    rows = [_Row() for _ in range(max(row_of.values()) + 1)]
    for node in nodes:
        if not node.side:
            rows[row_of[node.key]].nodes.append(node)
    crossing, pins = list[_Crossing](), list[_BorderPin]()
    for net in nets:
        source = by_key[net.source[0]]
        ends = [(by_key[key], pin) for key, pin in net.sinks]
        behind = sorted({row_of[node.key] for node, _ in ends if not node.side})
        border = [node for node, _ in ends if node.side]
        home = row_of[source.key] if not source.side else behind[0] if behind else 0
        pins += [_BorderPin(node, rows[home], net) for node in ([source] if source.side else []) + border]
        # In each row such a net is a separate part, from or to a pin at the row's border; `_connect` joins the parts.
        across = [row for row in behind if row != home]
        for row in sorted({home, *across}):
            here = [(node.key, pin) for node, pin in ends if not node.side and row_of[node.key] == row]
            start = net.source if row == home and not source.side else (rows[row].enter(net).key, _PIN)
            if row == home and (border or (across and not source.side)):
                here.append((rows[row].leave(net).key, _PIN))
            part = Net(f"{net.key} {row}", start, here, net.label if start is net.source else 0.0)
            rows[row].nets.append((net, part))
        if across:
            others = [rows[row] for row in across]
            from_border = _Crossing(net, None, [rows[home], *others])
            crossing.append(from_border if source.side else _Crossing(net, rows[home], others))
    return rows, crossing, pins


def _join_border(nodes: Sequence[Node], pins: Sequence[_BorderPin], width: float) -> None:
    """Place the pins on the border at the heights at which their nets end in the rows, and draw the wires to them."""
    for node in nodes:
        node.x = 0.0 if node.side < 0 else width + LANE if node.side > 0 else node.x
    for pin in pins:
        node, end = pin.node, pin.end
        node.y = end.y
        run = [(node.x, node.y), (end.x, end.y)]
        pin.net.runs.append(run if node.side < 0 else run[::-1])


def _leaving(row: _Row, crossing: Sequence[_Crossing]) -> list[Net]:
    """Return the nets that leave a row for another one, the lowest first."""
    found = [net for net, home, _ in crossing if home is row]
    return sorted(found, key=lambda net: -row.exits[net.key].y)


def _strip(row: _Row, crossing: Sequence[_Crossing]) -> float:
    """Return the height of the strip below a row."""
    count = len(_leaving(row, crossing))
    return LANE + count * TRACK if count else 0.0


def _place(rows: Sequence[_Row], crossing: Sequence[_Crossing]) -> None:
    """Lay out each row by itself, one below the other."""
    y = 0.0
    for row in rows:
        ends = [*row.entries.values(), *row.exits.values()]
        row.width, row.height = arrange([*row.nodes, *ends], [part for _, part in row.nets])
        row.y = y
        y += row.height + _strip(row, crossing) + GAP


def _connect(crossing: Sequence[_Crossing], left: float, at_border: set[int]) -> None:
    """Route the wires between rows: on the right down to the strip below the row, and on the left to the other rows."""
    order = {id(net): i for i, net in enumerate(_left_order(crossing))}
    for net, home, others in crossing:
        x = LANE + order[id(net)] * TRACK
        heights: list[float] = [row.entries[net.key].y for row in others]
        net.runs += [[(x, y), (left, y)] for y in heights]
        arms = dict.fromkeys(heights, 1)
        if home is None:  # the wire from the border comes in at the height of the first row
            arms[heights[0]] += 1
        else:
            level = _leaving(home, crossing).index(net)
            end = home.exits[net.key]
            turn, below = end.x + LANE + level * TRACK, home.y + home.height + LANE + level * TRACK
            net.runs.append([(end.x, end.y), (turn, end.y), (turn, below), (x, below)])
            if id(net) in at_border:
                net.dots.append((turn, end.y))
            heights.append(below)
            arms[below] = 1
        low, high = min(heights), max(heights)
        net.runs.append([(x, low), (x, high)])
        for y, count in arms.items():
            if count + (y > low) + (y < high) > 2:
                net.dots.append((x, y))


def _left_order(crossing: Sequence[_Crossing]) -> Iterator[Net]:
    """Yield the nets between rows by their places at the left, from the outside: long ways first."""

    def span(item: _Crossing) -> float:
        net, home, others = item
        ys = [row.entries[net.key].y for row in others] + ([home.y + home.height] if home else [])
        return -(max(ys, default=0.0) - min(ys, default=0.0)) if ys else math.inf

    yield from (net for net, _, _ in sorted(crossing, key=span))
