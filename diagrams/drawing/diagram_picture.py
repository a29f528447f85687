"""The picture of a diagram: its blocks and subsystems, laid out from the inside out, and drawn as SVG."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from typing import NamedTuple

from ...blocks import PID
from ...blocks.core import OptionError, Sum, near
from ..wiring import Structure, stepped_blocks
from .drawing_layout import Net
from .layers import Node, Pin
from .nets import Border, Nets, PinPlace
from .rows import arrange_in_rows
from .shapes import BORDER, GREY, INK, NAME, PLANT, WIRE, line, rect, seconds, style, text_at, width_of
from .symbols import Symbol, symbol_of

MANY = 40
"""Blocks above which subsystems are drawn closed by default."""

WIDTH = 1000.0
"""Width in pixels above which chains of blocks are broken into rows: that of a notebook's cell."""

HEADER, MARGIN, PIN = 24.0, 14.0, 18.0
TINTS = ("#eaf2fb", "#e6f5ec", "#f3ecfa", "#fdebec", "#e8f4f6", "#f6f2e2")
"""Colours of sampled subsystems, one for each sample time."""


def find_closed(table: Structure, subsystem: str, closed: bool | Iterable[str] | None, *, diagram: str) -> set[str]:
    """Return the subsystems that are drawn closed; `draw` says what the options mean, and what is refused."""
    known = {path for path in table.subsystems if path}
    if subsystem not in table.subsystems:
        raise OptionError(
            f"there is no subsystem {subsystem!r}. {near(subsystem, sorted(known))}", block=diagram, port="subsystem"
        )
    if closed is None:
        inside = [
            p
            for p, owner in table.subsystem_of.items()
            if not subsystem or owner == subsystem or owner.startswith(subsystem + ".")
        ]
        closed = len(inside) > MANY
    if isinstance(closed, bool):
        return known if closed else set()
    shut = {closed} if isinstance(closed, str) else set(closed)
    for path in sorted(shut - known):
        raise OptionError(f"there is no subsystem {path!r}. {near(path, known)}", block=diagram, port="closed")
    return shut


class DrawnPage(NamedTuple):
    """A drawing: its SVG, its width and height in pixels, and what it shows, in words."""

    svg: str
    width: float
    height: float
    about: str


class DiagramPicture:
    """A drawing in the making."""

    def __init__(self, table: Structure, closed: set[str], limit: float):
        self.table = table
        self.limit = limit
        self.closed = closed
        rates = sorted({f.sample_time for f in table.subsystems.values() if f.sample_time is not None})
        self.tints = {rate: TINTS[i % len(TINTS)] for i, rate in enumerate(rates)}
        self.nets = Nets(table)
        self.symbols: dict[str, Symbol | None] = {}

    # --- layout -----------------------------------------------------------------------------------------------------

    def page(self, subsystem: str, title: str) -> DrawnPage:
        """Return the whole SVG."""
        body, w, h, pins = self._lay_out(subsystem)
        left, right, top, border = MARGIN, MARGIN, MARGIN, ""
        if subsystem:  # its border, and the names of the pins on it
            texts = {
                name: (side, text) for side, names in enumerate(self._pin_texts(subsystem)) for name, text in names
            }
            wide = [max((width_of(text, 9) for side, text in texts.values() if side == i), default=0.0) for i in (0, 1)]
            left, right, top = left + wide[0] + 16 + MARGIN, right + wide[1] + 16 + MARGIN, top + HEADER
            border = self._border(subsystem, -MARGIN, -HEADER, w + 2 * MARGIN, h + HEADER + MARGIN)
            for pin in pins:
                (name,) = (*pin.ins, *pin.outs)
                start, end = (-MARGIN - 14, 0.0) if pin.side < 0 else (pin.x, w + MARGIN + 14)
                anchor, at = ("end", start - 4) if pin.side < 0 else ("", end + 4)
                border += line([(start, pin.y), (end, pin.y)])
                border += text_at(at, pin.y + 3, texts[name][1], 9, anchor=anchor, fill=NAME, italic=True)
        w, h = w + left + right, h + top + 2 * MARGIN
        about = f"Block diagram of {title}: {len(self.table.blocks)} blocks."
        svg = (
            f'<svg xmlns="http://www.w3.org/2000/svg" class="lw-drawing" width="{w:g}" height="{h:g}" '
            f'viewBox="0 0 {w:g} {h:g}" style="max-width:100%;height:auto" role="img" '
            f'font-family="Helvetica, Arial, sans-serif" font-size="10" fill="{INK}">\n'
            f"<title>{escape(about)}</title>\n{style()}"
            f'<g transform="translate({left:g} {top:g})">\n{border}{body}</g>\n</svg>\n'
        )
        return DrawnPage(svg, w, h, about)

    def _lay_out(self, subsystem: str, depth: int = 0) -> tuple[str, float, float, list[Node]]:
        """Lay out the inside of a subsystem; return its drawing, its width and height, and the pins on its border."""
        table = self.table
        items = [p for p, f in table.subsystem_of.items() if f == subsystem]
        inner = [p for p in table.subsystems if p and p.rpartition(".")[0] == subsystem]
        drawn: dict[str, tuple[str, list[Node]]] = {}
        nodes = []
        for path in [*items, *inner]:
            if path in table.blocks:
                nodes.append(self._block_node(path))
            elif path in self.closed:
                nodes.append(self._closed_node(path))
            else:
                # an open subsystem is as large as its inside, so that this is laid out first
                body, w, h, pins = self._lay_out(path, depth + 1)
                node = Node(path, max(w + 2 * MARGIN, width_of(self._header(path), 10, True) + 20), h + HEADER + MARGIN)
                node.ins = {name: p.y + HEADER for p in pins for name in p.outs}
                node.outs = {name: p.y + HEADER for p in pins for name in p.ins}
                self._place_control_pins(node)
                drawn[path] = (body, pins)
                nodes.append(node)
            nodes[-1].plant = self._has_plant(path)
            nodes[-1].controller = self._controller_rank(path)
        borders = []
        if subsystem:
            entering, leaving = PinPlace(subsystem, Border.INPUTS), PinPlace(subsystem, Border.OUTPUTS)
            borders = [
                Node(entering.key(n), 0, 0, {}, {n: 0.0}, -1) for n in self.nets.ins.get(subsystem, []) if not n.control
            ]
            borders += [Node(leaving.key(n), 0, 0, {n: 0.0}, {}, 1) for n in self.nets.outs.get(subsystem, [])]
        nets, names = [], []
        for (place, pin), sinks in self.nets.of[subsystem].items():
            name = self.nets.label_at(place, pin, sinks)
            part = any(self.nets.is_part(*sink) for sink in sinks)
            label = (width_of(name, 9) + 10 if name else 0.0) + (14.0 if part else 0.0)
            ends = [(end.key(p), p) for end, p in sinks]
            nets.append(Net(f"{place} {pin}", (place.key(pin), pin), ends, label))
            names.append(name)
        w, h = arrange_in_rows([*borders, *nodes], nets, self.limit - depth * 2 * MARGIN)
        labels = [self._label(net, name, nodes) for net, name in zip(nets, names, strict=True)]
        out = [self._signal(net, self._wire(net)) for net in nets]
        out += [self._item(node, drawn.get(node.key)) for node in nodes]
        out += [self._signal(net, label) for net, label in zip(nets, labels, strict=True) if label]
        return "".join(out), w, h, borders

    def _place_control_pins(self, node: Node) -> None:
        for pin in self.nets.ins.get(node.key, []):
            if pin.control:
                node.ins[pin] = HEADER / 2

    def _controller_rank(self, path: str) -> int | None:
        """Return how surely a loop begins here: at a sampled subsystem, or where a signal is compared with another."""
        block = self.table.blocks.get(path)
        if block is None:
            return 0 if self.table.rate(path) is not None and not self._has_plant(path) else None
        compares = isinstance(block, PID) or (isinstance(block, Sum) and len(set(block.signs)) == 2)
        return 1 if compares else None

    def _has_plant(self, path: str) -> bool:
        return bool(stepped_blocks(self.table, path))

    def _pin_texts(self, path: str) -> tuple[list[tuple[Pin, str]], list[tuple[Pin, str]]]:
        """Return pins and their texts, inputs and outputs, in the order in which they are."""
        ins, outs = self.nets.ins.get(path, []), self.nets.outs.get(path, [])
        block = self.table.blocks.get(path)
        if block is None:

            def text(pin: Pin) -> str:
                if pin.control:
                    return {"enabled": "enable", "triggered": "trigger"}[self.table.subsystems[path].control]
                alone = len(self.table.blocks[pin.maker].outputs) == 1
                return self.nets.name_of(path, pin) or (pin.maker.rpartition(".")[2] if alone else pin.port)

            return [(n, text(n)) for n in ins], [(n, text(n)) for n in outs]
        declared_in, declared_out = list(block.inputs), list(block.outputs)
        ins = sorted(ins, key=lambda pin: declared_in.index(pin.port))
        outs = sorted(outs, key=lambda pin: declared_out.index(pin.port))
        if isinstance(block, Sum):
            signs = [block.signs[declared_in.index(n.port)].replace("-", "−") for n in ins]
            return list(zip(ins, signs, strict=True)), [(n, "") for n in outs]
        wired = {pin.port for pin in outs}
        main = [n for n, port in block.outputs.items() if n in wired or not getattr(port, "secondary", False)]
        plain_in, plain_out = (len(ports) == 1 and not block.stepped for ports in (declared_in, main))
        return [(n, "" if plain_in else n.port) for n in ins], [(n, "" if plain_out else n.port) for n in outs]

    def _block_node(self, path: str) -> Node:
        ins, outs = self._pin_texts(path)
        title, kind = self._titles(path)
        if isinstance(self.table.blocks[path], Sum):
            rows = max(len(ins), 1)
            node = Node(path, 34.0, max(rows * 16.0 + 4, 30.0))
            top, pitch = node.height / 2 - (rows - 1) * 8.0, 16.0
        else:
            inside = self._symbol(path)
            wide, high = inside.size if inside else (0.0, 0.0)
            texts = width_of(title, 10.5, True), width_of(kind, 8.5) if self._shows_kind(path) else 0.0
            rows = max(len(ins), len(outs), 1)
            if self._has_named_pins(path):
                sides = [max((width_of(t, 8.5) for _, t in pins), default=0.0) for pins in (ins, outs)]
                across = 2 * max(sides) + wide + 24 if inside else sum(sides) + 16
                head = 34.0 if self._shows_kind(path) else 22.0
                room = max(rows * PIN, high + 4)
                node = Node(path, max(*texts, across) + 18, head + room)
                top, pitch = head + PIN / 2 + (room - rows * PIN) / 2, PIN
            else:
                node = Node(path, max(*texts, wide) + 18, 27.0 + high if inside else 40.0)
                top, pitch = (21.0 + high / 2 if inside else 20.0), PIN
        node.ins = {n: top + i * pitch for i, (n, _) in enumerate(ins)}
        node.outs = {n: top + i * pitch for i, (n, _) in enumerate(outs)}
        if isinstance(self.table.blocks[path], Sum):
            node.outs = dict.fromkeys(node.outs, round(node.height / 2))
        return node

    def _symbol(self, path: str) -> Symbol | None:
        if path not in self.symbols:
            self.symbols[path] = symbol_of(self.table.blocks[path])
        return self.symbols[path]

    def _shows_kind(self, path: str) -> bool:
        """Whether the block's kind is written below its name: its symbol says it as well."""
        return self._symbol(path) is None

    def _has_named_pins(self, path: str) -> bool:
        return any(text for pins in self._pin_texts(path) for _, text in pins)

    def _closed_node(self, path: str) -> Node:
        ins, outs = self._pin_texts(path)
        rows = max(len(ins), len(outs), 1)
        sides = sum(max((width_of(t, 8.5) for _, t in pins), default=0.0) for pins in (ins, outs))
        node = Node(path, max(width_of(self._header(path), 10, True), sides + 16) + 24, 40.0 + rows * PIN)
        node.ins = {n: 40.0 + i * PIN for i, (n, _) in enumerate(ins)}
        node.outs = {n: 40.0 + i * PIN for i, (n, _) in enumerate(outs)}
        return node

    def _titles(self, path: str) -> tuple[str, str]:
        kind = self.table.blocks[path].drawn_as
        return path.rpartition(".")[2], kind if len(kind) < 36 else kind[:33] + "…"

    def _header(self, path: str) -> str:
        return " · ".join(self._headings(path))

    def _headings(self, path: str) -> list[str]:
        """Return the texts at a subsystem's upper edge: its name, its rate, its conditions."""
        settings = self.table.subsystems[path]
        texts = [path.rpartition(".")[2]]
        if settings.sample_time is not None:
            texts.append(f"every {seconds(settings.sample_time)}")
        if settings.offset:
            texts.append(f"from {seconds(settings.offset)}")
        if settings.delay:
            texts.append(f"delay {settings.delay} sample{'s' if settings.delay > 1 else ''}")
        if settings.control:
            texts.append(f"{settings.control}, {settings.when}")
        return texts

    # --- drawing ----------------------------------------------------------------------------------------------------

    def _item(self, node: Node, inner: tuple[str, list[Node]] | None) -> str:
        path, x, y, w, h = node.key, node.x, node.y, node.width, node.height
        if path in self.table.blocks:
            return self._block_shape(node)
        out = [self._border(path, x, y, w, h)]
        if inner is None:
            out.append(self._pin_marks(node))
            return "".join(out)
        body, pins = inner
        out.append(f'<g transform="translate({x + MARGIN:g} {y + HEADER:g})">\n{body}</g>\n')
        for pin in pins:  # from the border to the drawing of the inside
            at = y + HEADER + pin.y
            a, b = (x, x + MARGIN) if pin.side < 0 else (x + MARGIN + pin.x, x + w)
            out.append(line([(a, at), (b, at)]))
        return "".join(out)

    def _border(self, path: str, x: float, y: float, w: float, h: float) -> str:
        """Return the border of a subsystem, with its texts."""
        rate = self.table.rate(path)
        tint = self.tints[rate] if rate is not None else "#f5f6f7"
        kind = f"lw-rate{TINTS.index(tint)}" if rate is not None else "lw-plain"
        name, *rest = self._headings(path)
        more = (
            f'<tspan class="lw-grey" fill="{GREY}" font-weight="normal"> · {escape(" · ".join(rest))}</tspan>'
            if rest
            else ""
        )
        dash = ' stroke-dasharray="5 3"' if self.table.subsystems[path].control else ""
        return (
            f'<g data-subsystem="{escape(path, quote=True)}"><title>{escape(path)}</title>'
            f'<rect class="{kind}" x="{x:g}" y="{y:g}" width="{w:g}" height="{h:g}" '
            f'rx="5" fill="{tint}" stroke="{BORDER}"{dash}/>\n'
            f'<text x="{x + 10:g}" y="{y + 16:g}" font-weight="bold">{escape(name)}{more}</text></g>\n'
        )

    def _block_shape(self, node: Node) -> str:
        path, x, y, w, h = node.key, node.x, node.y, node.width, node.height
        block = self.table.blocks[path]
        title, kind = self._titles(path)
        plant = block.stepped
        middle = x + w / 2
        out = [f'<g data-block="{escape(path, quote=True)}"><title>{escape(path)}: {escape(kind)}</title>']
        if isinstance(block, Sum):
            out.append(rect(x, y, w, h, "#ffffff", 12))
            out.append(text_at(middle + 4, y + h / 2 + 5, "Σ", 14, anchor="middle"))
        else:
            out.append(rect(x, y, w, h, PLANT if plant else "#ffffff", 3, 1.4 if plant else 1))
            if plant:
                out.append(rect(x + 2.5, y + 2.5, w - 5, h - 5, "none", 2, 0.7))
            inside, named, shown = self._symbol(path), self._has_named_pins(path), self._shows_kind(path)
            top = y + (h / 2 - 2.5 if not named and not inside else 16)
            out.append(text_at(middle, top, title, 10.5, anchor="middle", bold=True))
            if shown:
                out.append(text_at(middle, top + 11.5, kind, 8.5, anchor="middle", fill=GREY))
            if inside:
                head = 34.0 if shown and named else 22.0
                out.append(inside.draw(middle, y + (head + (h - head) / 2 - 1 if named else 21 + inside.size[1] / 2)))
        out.append(self._pin_marks(node) + "</g>\n")
        return "".join(out)

    def _pin_marks(self, node: Node) -> str:
        out = []
        ins, outs = self._pin_texts(node.key)
        for name, text in ins:
            out.append(text_at(node.x + 6, node.y + node.ins[name] + 3, text, 8.5, fill=GREY) if text else "")
        for name, text in outs:
            at = node.x + node.width - 6
            out.append(text_at(at, node.y + node.outs[name] + 3, text, 8.5, anchor="end", fill=GREY) if text else "")
        return "".join(out)

    def _signal(self, net: Net, shapes: str) -> str:
        """Return shapes of a wire, marked as those of its signal."""
        place, pin = net.source
        name = f"{pin.maker or place}.{pin.port}"
        return f'<g data-signal="{escape(name, quote=True)}">{shapes}</g>\n'

    def _wire(self, net: Net) -> str:
        out = [line(*net.runs)] if net.runs else []
        out += [f'<circle class="lw-mark" cx="{x:g}" cy="{y:g}" r="2.2" fill="{WIRE}"/>\n' for x, y in net.dots]
        return "".join(out)

    def _label(self, net: Net, name: str, nodes: list[Node]) -> str:
        """Return a wire's name behind its source, and arrows and indices ahead of its sinks."""
        out = []
        by_key = {node.key: node for node in nodes}
        source = by_key.get(net.source[0])
        if source is not None:
            x, y = source.x + source.width, source.y + source.outs[net.source[1]]
            if name:
                out.append(text_at(x + 5, y - 3.5, name, 9, fill=NAME, italic=True))
        for item, pin in net.sinks:
            if item in by_key:
                node = by_key[item]
                x, y = node.x, node.y + node.ins[pin]
                out.append(f'<path class="lw-mark" d="M{x:g} {y:g}l-6.5 -3v6z" fill="{WIRE}"/>\n')
                part = self.nets.parts.get((item, pin))
                if part is not None:
                    out.append(text_at(x - 8, y - 3.5, part, 8, anchor="end", fill=GREY))
        return "".join(out)
