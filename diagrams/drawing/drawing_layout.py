"""Layout of a drawing: blocks in layers from left to right, wires in the channels between them.

Signals run from left to right. A wire that closes a loop runs back below everything else: behind a plant, or else ahead
of the block at which the loop is entered. All coordinates are in pixels. The same diagram always gives the same
drawing.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from .layers import Node, Pin, cut_loops, order_layers, place_layers

GAP, LANE, TRACK, LEAST = 22.0, 12.0, 9.0, 26.0
"""Between nodes; around a wire that passes a layer; between parallel wires; the narrowest channel."""

Point = tuple[float, float]


@dataclass(eq=False)
class Net:
    """A wire from an output to all its consumers; each end is a node's key and a pin."""

    key: str
    source: tuple[str, Pin]
    sinks: list[tuple[str, Pin]]
    label: float = 0.0  # width of the name at its source
    below: float = 0.0  # height at which it runs back, where it closes a loop
    runs: list[list[Point]] = field(default_factory=list)  # its polylines
    dots: list[Point] = field(default_factory=list)  # its branching points


End = tuple[Node, float]
"""A node, and the height of a pin below its upper edge."""


@dataclass(eq=False)
class _Part:
    """The part of a net in a channel: from a node on the left to some on the right, and down to its way back."""

    net: Net
    start: End | None
    ends: list[End]
    back: bool = False
    track: int = 0
    x: float = 0.0

    @property
    def left(self) -> float | None:
        return None if self.start is None else self.start[0].y + self.start[1]

    @property
    def rights(self) -> list[float]:
        return [node.y + dy for node, dy in self.ends]

    def span(self, floor: float) -> tuple[float, float]:
        ys = [*self.rights, *([] if self.left is None else [self.left]), *([floor] if self.back else [])]
        return min(ys), max(ys)


def arrange(nodes: Sequence[Node], nets: Sequence[Net]) -> tuple[float, float]:
    """Place nodes and route nets, in place, and return the width and height; ties go by the order of the nodes."""
    by_key = {node.key: node for node in nodes}
    pairs = [(net.source[0], sink[0]) for net in nets for sink in net.sinks]
    _assign_layers(nodes, pairs)
    depth = max((node.layer for node in nodes), default=0) + 1
    layers: list[list[Node]] = [[n for n in nodes if n.layer == i] for i in range(depth)]
    for node in nodes:
        node.loose = not node.ins
    lanes = _add_lanes(nets, by_key, layers)
    links = _find_links(nets, by_key, lanes)
    layers = order_layers(layers, links)
    place_layers(layers, links, gap=lambda a, b: LANE if a.lane or b.lane or (a.side and b.side) else GAP)
    floor = max((n.y + n.height for layer in layers for n in layer), default=0.0)
    channels = _find_parts(nets, by_key, lanes, depth)
    x = 0.0
    for index in range(-1, depth):
        if index >= 0:
            width = max(n.width for n in layers[index]) if layers[index] else 0.0
            for node in layers[index]:
                node.x = x + (width if node.side > 0 else 0.0 if node.side < 0 else (width - node.width) / 2)
                if node.lane:
                    node.x, node.width = x, width
            x += width
        x = _assign_tracks(channels[index], x, floor, outside=index in (-1, depth - 1))
    bottom = _route_back(nets, channels, floor)
    _draw(channels)
    return x, bottom


def _assign_layers(nodes: Sequence[Node], pairs: Sequence[tuple[str, str]]) -> None:
    """Give every node its layer, behind the nodes that drive it; wires that close loops don't count."""
    controllers = {n.key: n.controller for n in nodes if n.controller is not None}
    forward = cut_loops([n.key for n in nodes], pairs, {n.key for n in nodes if n.plant}, controllers)
    before: dict[str, list[str]] = {n.key: [] for n in nodes}
    after: dict[str, list[str]] = {n.key: [] for n in nodes}
    for a, b in forward:
        before[b].append(a)
        after[a].append(b)
    layer: dict[str, int] = {}
    first = 1 if any(n.side < 0 for n in nodes) else 0
    waiting = {n.key: len(before[n.key]) for n in nodes}
    ready = [n for n in waiting if not waiting[n]]
    ends = {n.key: n.side for n in nodes}
    order = []
    while ready:
        key = ready.pop(0)
        order.append(key)
        layer[key] = 0 if ends[key] < 0 else max((layer[b] + 1 for b in before[key]), default=first)
        for follower in after[key]:
            waiting[follower] -= 1
            if not waiting[follower]:
                ready.append(follower)
    for key in reversed(order):  # sources are next to what they drive
        if not before[key] and after[key] and not ends[key]:
            layer[key] = max(min(layer[a] for a in after[key]) - 1, first)
    last = max((layer[n.key] for n in nodes if n.side <= 0), default=-1) + 1
    for node in nodes:
        node.layer = last if node.side > 0 else layer[node.key]


def _add_lanes(nets: Sequence[Net], by_key: dict[str, Node], layers: list[list[Node]]) -> dict[tuple[str, int], Node]:
    """Add a node without content wherever a net passes a layer."""
    lanes: dict[tuple[str, int], Node] = {}
    for net in nets:
        start = by_key[net.source[0]].layer
        end = max((by_key[s].layer for s, _ in net.sinks), default=start)
        for i in range(start + 1, end):
            node = Node(f"{net.key} {i}", 0.0, 0.0, {Pin(""): 0.0}, {Pin(""): 0.0}, lane=True, layer=i)
            node.loose = by_key[net.source[0]].loose
            lanes[net.key, i] = node
            layers[i].append(node)
    return lanes


def _sinks_in(net: Net, by_key: dict[str, Node], layer: int) -> Iterable[tuple[Node, Pin]]:
    """Yield the sinks of a net in a layer."""
    return ((by_key[s], pin) for s, pin in net.sinks if by_key[s].layer == layer)


def _find_links(
    nets: Sequence[Net], by_key: dict[str, Node], lanes: dict[tuple[str, int], Node]
) -> list[tuple[Node, float, Node, float]]:
    """Return the wires between neighbouring layers, to be drawn straight: node, pin's height, node, pin's height."""
    links = []
    for net in nets:
        node, pin = by_key[net.source[0]], net.source[1]
        dy, i = node.outs[pin], node.layer + 1
        while True:
            links += [(node, dy, sink, sink.ins[p]) for sink, p in _sinks_in(net, by_key, i)]
            if (net.key, i) not in lanes:
                break
            links.append((node, dy, lanes[net.key, i], 0.0))
            node, dy, i = lanes[net.key, i], 0.0, i + 1
    return links


def _find_parts(
    nets: Sequence[Net], by_key: dict[str, Node], lanes: dict[tuple[str, int], Node], depth: int
) -> dict[int, list[_Part]]:
    """Return the parts of all nets by channel; channel i lies behind layer i."""
    channels: dict[int, list[_Part]] = {i: [] for i in range(-1, depth)}
    for net in nets:
        source = by_key[net.source[0]]
        first = source.layer
        last = max((by_key[s].layer for s, _ in net.sinks), default=first)
        behind = sorted({by_key[s].layer for s, _ in net.sinks if by_key[s].layer <= first})
        for i in range(first, max(last, first + 1)):
            start = (source, source.outs[net.source[1]]) if i == first else (lanes[net.key, i], 0.0)
            ends = [(node, node.ins[pin]) for node, pin in _sinks_in(net, by_key, i + 1)]
            if (net.key, i + 1) in lanes:
                ends.append((lanes[net.key, i + 1], 0.0))
            channels[i].append(_Part(net, start, ends, back=bool(behind) and i == first))
        for layer in behind:
            ends = [(node, node.ins[pin]) for node, pin in _sinks_in(net, by_key, layer)]
            channels[layer - 1].append(_Part(net, None, ends, back=True))
    return channels


def _assign_tracks(parts: list[_Part], x: float, floor: float, *, outside: bool) -> float:
    """Give the upright pieces of a channel their places; return the x at which the channel ends."""
    placed: list[_Part] = []
    waiting = sorted((p for p in parts if _is_upright(p, floor)), key=lambda p: _preference(p, floor))
    while waiting:
        free = [p for p in waiting if not any(_turns_first(b, p) for b in waiting)]
        if not free:  # they wait for one another in a circle, so one of them changes its height on the way
            rest = _split_part(waiting[0], parts)
            parts.append(rest)
            waiting.append(rest)
            continue
        part = free[0]
        waiting.remove(part)
        low, high = part.span(floor)
        busy = {p.track for p in placed if p.span(floor)[0] < high + LANE / 2 and low < p.span(floor)[1] + LANE / 2}
        part.track = max((b.track + 1 for b in placed if _turns_first(b, part)), default=0)
        while part.track in busy:
            part.track += 1
        placed.append(part)
    names = max((p.net.label for p in parts if p.start is not None and not p.start[0].lane), default=0.0)
    tracks = max((p.track + 1 for p in placed), default=0)
    for part in parts:
        part.x = x + max(names, LANE) + part.track * TRACK
        if part.start is not None and part.start[0].layer < 0:  # behind a dogleg
            part.start[0].x = part.x
    if outside and not parts:
        return x
    return x + max(LEAST, max(names, LANE) + max(tracks - 1, 0) * TRACK + LANE + 4)


def _is_upright(part: _Part, floor: float) -> bool:
    low, high = part.span(floor)
    return high > low


def _turns_first(a: _Part, b: _Part) -> bool:
    """Return whether a part must turn ahead of another: it enters the channel at a height at which the other leaves."""
    if any(node.layer < 0 and a.start == (node, dy) for node, dy in b.ends):
        return False
    if b.start is not None and any(node.layer < 0 and b.start == (node, dy) for node, dy in a.ends):
        return True  # the piece behind a knee comes later
    return a.net is not b.net and a.left is not None and any(abs(a.left - right) < 3.0 for right in b.rights)


def _split_part(part: _Part, parts: list[_Part]) -> _Part:
    """Split a part at a height at which no other one enters or leaves; return the piece behind."""
    taken = [y for p in parts for y in (*p.rights, *([] if p.left is None else [p.left]))]
    begin = part.rights[0] if part.left is None else part.left
    steps = (begin + sign * 4.0 * k for k in range(1, 500) for sign in (1, -1))
    height = next(y for y in steps if all(abs(y - other) > 3.5 for other in taken))
    knee = Node(f"{part.net.key} knee", 0.0, 0.0, lane=True, layer=-1, y=height)
    rest = _Part(part.net, (knee, 0.0), part.ends)
    part.ends = [(knee, 0.0)]
    return rest


def _preference(part: _Part, floor: float) -> tuple[float, ...]:
    """Return a sorting key that keeps crossings few: rising pieces first, from above, then falling ones, from below."""
    low, high = part.span(floor)
    if part.left is None:
        return (2.0, -low)
    falls = high > part.left + 1e-6
    return (1.0, -part.left) if falls else (0.0, part.left)


def _route_back(nets: Sequence[Net], channels: dict[int, list[_Part]], floor: float) -> float:
    """Route the wires that run back below everything, short ways above long ones; return the lower edge."""
    ways = []
    for net in nets:
        xs = [p.x for parts in channels.values() for p in parts if p.net is net and p.back]
        if xs:
            ways.append((max(xs) - min(xs), min(xs), max(xs), net))
    levels: list[list[tuple[float, float]]] = []
    for _, low, high, net in sorted(ways, key=lambda w: w[:3]):
        level = 0
        while level < len(levels) and any(a < high + TRACK and low < b + TRACK for a, b in levels[level]):
            level += 1
        if level == len(levels):
            levels.append([])
        levels[level].append((low, high))
        net.below = y = floor + LANE + 4 + level * TRACK
        net.runs.append([(low, y), (high, y)])
        xs = sorted(p.x for parts in channels.values() for p in parts if p.net is net and p.back)
        net.dots += [(x, y) for x in xs[1:-1]]
    return floor + (LANE + 4 + (len(levels) - 1) * TRACK + 4 if levels else 0.0)


def _draw(channels: dict[int, list[_Part]]) -> None:
    """Turn the parts into polylines, from the left edge of a channel to its right edge."""
    for part in (part for parts in channels.values() for part in parts):
        net = part.net
        ends = [(node.x, node.y + dy) for node, dy in part.ends]
        down = [net.below] if part.back else []
        ys = [*(y for _, y in ends), *down]
        if part.start is not None and part.left is not None:
            ys.append(part.left)
            node = part.start[0]
            begin = node.x if node.lane else node.x + node.width  # a lane is drawn along with the piece behind it
            net.runs.append([(begin, part.left), (part.x, part.left)])
        if max(ys) > min(ys):
            net.runs.append([(part.x, min(ys)), (part.x, max(ys))])
        net.runs += [[(part.x, y), (x, y)] for x, y in ends]
        for height in sorted(set(ys) - set(down)):
            arms = (part.left == height) + sum(y == height for _, y in ends)
            if arms + (min(ys) < height) + (max(ys) > height) > 2:
                net.dots.append((part.x, height))
