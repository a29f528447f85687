"""Places of a written SSP's elements, for tools that draw it: those of a drawing of the diagram."""

from __future__ import annotations

from ..drawing import Net, Node, Pin, arrange
from .documents import WrittenElement

_SCALE = 0.25
"""mm of the SSP's canvas for each pixel of a drawing."""
_WIDTH, _ROW, _LEAST, _MARGIN = 130.0, 16.0, 44.0, 40.0
"""Pixels: width of an element, height for each connector, least height, and around all elements."""


def lay_out(system: WrittenElement) -> None:
    """Place the elements of a system and of those in it, and their connectors: inputs on the left, outputs right."""
    nodes: list[Node] = []
    for element in system.elements.values():
        if element.elements:
            lay_out(element)
        ins, outs = (
            [n for n, c in element.connectors.items() if (c.kind == "input") == side] for side in (True, False)
        )
        height = max(_LEAST, _ROW * (max(len(ins), len(outs)) + 1))
        on_left, on_right = (
            {Pin(n): height * (i + 1) / (len(names) + 1) for i, n in enumerate(names)} for names in (ins, outs)
        )
        nodes.append(Node(element.name, _WIDTH, height, on_left, on_right))
        _place_connectors(element)
    nets: dict[tuple[str, str], Net] = {}
    for connection in system.connections:
        (start, a), (end, b) = connection.start, connection.end
        if start and end:
            net = nets.setdefault((start, a), Net(f"{start}.{a}", (start, Pin(a)), []))
            net.sinks.append((end, Pin(b)))
    width, height = arrange(nodes, list(nets.values()))
    width, height = width + 2 * _MARGIN, height + 2 * _MARGIN
    system.canvas = _SCALE * width, _SCALE * height
    for node in nodes:
        left, low = node.x + _MARGIN, height - (node.y + _MARGIN + node.height)
        edges = left, low, left + node.width, low + node.height
        x1, y1, x2, y2 = (_SCALE * edge for edge in edges)
        system.elements[node.key].box = x1, y1, x2, y2
    _place_connectors(system)


def _place_connectors(element: WrittenElement) -> None:
    for is_input in (True, False):
        side = [c for c in element.connectors.values() if (c.kind == "input") == is_input]
        for i, connector in enumerate(side):
            connector.place = (0.0 if is_input else 1.0), 1.0 - (i + 1) / (len(side) + 1)
