"""The drawing of a diagram, as SVG, made from the diagram itself."""

from __future__ import annotations

import os
from collections.abc import Iterable
from html import escape
from pathlib import Path

from ...blocks.core import OptionError, Sum, accepts, check_file, explain_calls, kinds, near, write_text
from ..wiring import Structure, stepped_blocks
from .drawing_layout import Net, arrange
from .nets import Border, Nets, PinPlace
from .order import Node, Pin
from .shapes import BORDER, GREY, INK, NAME, PLANT, WIRE, line, rect, seconds, text_at, width

MANY = 40
"""Blocks above which subsystems are drawn closed by default."""

HEADER, MARGIN, PIN = 24.0, 14.0, 18.0
TINTS = ("#eaf2fb", "#e6f5ec", "#f3ecfa", "#fdebec", "#e8f4f6", "#f6f2e2")
"""Colours of sampled subsystems, one for each sample time."""


@explain_calls
class Drawing:
    """A diagram's drawing; a notebook shows it.

    Attributes
    ----------
    svg : str
        The drawing.
    """

    def __init__(self, svg: str):
        self.svg = svg

    def _repr_svg_(self) -> str:
        return self.svg

    def __repr__(self) -> str:
        return f"<drawing, {len(self.svg)} characters of SVG>"

    @accepts(path=kinds.path)
    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the drawing to a file, ``.svg``, and return the file.

        Raises
        ------
        OptionError
            If the file has another ending, or its folder isn't there.
        """
        file = Path(path)
        if file.suffix.lower() != ".svg":
            raise OptionError(f"found {str(path)!r}; expected a file for SVG; name it {file.stem}.svg.")
        write_text(check_file(file), self.svg)
        return file


@accepts(subsystem=kinds.text, closed=kinds.either(kinds.flag, kinds.names))
def draw(table: Structure, name: str, *, subsystem: str = "", closed: bool | Iterable[str] | None = None) -> str:
    """Return the drawing of a diagram, or of the inside of one of its subsystems, as SVG.

    Parameters
    ----------
    table : Structure
        The diagram's blocks and wires.
    name : str
        The diagram's name.
    subsystem : str
        Path of the subsystem whose inside is drawn; the whole diagram without it.
    closed : bool or list of str, optional
        Subsystems that are drawn closed, all or some; by default all of them in a diagram of more than 40 blocks.

    Raises
    ------
    OptionError
        If a path stands for no subsystem.
    """
    paths = [path for path in table.subsystems if path]
    shut = _find_closed(table, subsystem, closed, diagram=name)
    if subsystem not in table.subsystems:
        raise OptionError(
            f"there is no subsystem {subsystem!r}. {near(subsystem, paths)}", block=name, port="subsystem"
        )
    return _Picture(table, shut - {subsystem}).page(subsystem, subsystem or name)


def _find_closed(table: Structure, subsystem: str, closed: bool | Iterable[str] | None, *, diagram: str) -> set[str]:
    known = {path for path in table.subsystems if path}
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


class _Picture:
    """A drawing in the making."""

    def __init__(self, table: Structure, closed: set[str]):
        self.table = table
        self.closed = closed
        rates = sorted({f.sample_time for f in table.subsystems.values() if f.sample_time is not None})
        self.tints = {rate: TINTS[i % len(TINTS)] for i, rate in enumerate(rates)}
        self.nets = Nets(table)

    # --- layout -----------------------------------------------------------------------------------------------------

    def page(self, subsystem: str, title: str) -> str:
        """Return the whole SVG."""
        body, w, h, pins = self._lay_out(subsystem)
        left, right, top, border = MARGIN, MARGIN, MARGIN, ""
        if subsystem:  # its border, and the names of the pins on it
            texts = {
                name: (side, text) for side, names in enumerate(self._pin_texts(subsystem)) for name, text in names
            }
            wide = [max((width(text, 9) for side, text in texts.values() if side == i), default=0.0) for i in (0, 1)]
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
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{w:g}" height="{h:g}" viewBox="0 0 {w:g} {h:g}" '
            f'role="img" font-family="Helvetica, Arial, sans-serif" font-size="10" fill="{INK}">\n'
            f"<title>{escape(about)}</title>\n"
            f'<g transform="translate({left:g} {top:g})">\n{border}{body}</g>\n</svg>\n'
        )

    def _lay_out(self, subsystem: str) -> tuple[str, float, float, list[Node]]:
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
                body, w, h, pins = self._lay_out(path)
                node = Node(path, max(w + 2 * MARGIN, width(self._header(path), 10, True) + 20), h + HEADER + MARGIN)
                node.ins = {name: p.y + HEADER for p in pins for name in p.outs}
                node.outs = {name: p.y + HEADER for p in pins for name in p.ins}
                self._place_control_pins(node)
                drawn[path] = (body, pins)
                nodes.append(node)
            nodes[-1].plant = self._has_plant(path)
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
            label = (width(name, 9) + 10 if name else 0.0) + (14.0 if part else 0.0)
            ends = [(end.key(p), p) for end, p in sinks]
            nets.append(Net(f"{place} {pin}", (place.key(pin), pin), ends, label))
            names.append(name)
        w, h = arrange([*borders, *nodes], nets)
        out = [self._wire(net) for net in nets]
        out += [self._item(node, drawn.get(node.key)) for node in nodes]
        out += [self._label(net, name, nodes) for net, name in zip(nets, names, strict=True)]
        return "".join(out), w, h, borders

    def _place_control_pins(self, node: Node) -> None:
        for pin in self.nets.ins.get(node.key, []):
            if pin.control:
                node.ins[pin] = HEADER / 2

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
        plain_in, plain_out = len(declared_in) == 1, len(declared_out) == 1
        return [(n, "" if plain_in else n.port) for n in ins], [(n, "" if plain_out else n.port) for n in outs]

    def _block_node(self, path: str) -> Node:
        ins, outs = self._pin_texts(path)
        title, kind = self._titles(path)
        if isinstance(self.table.blocks[path], Sum):
            rows = max(len(ins), 1)
            node = Node(path, 34.0, max(rows * 16.0 + 4, 30.0))
            top, pitch = node.height / 2 - (rows - 1) * 8.0, 16.0
        else:
            texts = width(title, 10.5, True), width(kind, 8.5)
            rows = max(len(ins), len(outs), 1)
            sides = max((width(t, 8.5) for _, t in ins), default=0) + max((width(t, 8.5) for _, t in outs), default=0)
            named = any(t for _, t in [*ins, *outs])
            node = Node(path, max(*texts, sides + 16) + 18, (34.0 if named else 22.0) + rows * PIN if named else 40.0)
            top, pitch = (34.0 + PIN / 2, PIN) if named else (20.0, PIN)
        node.ins = {n: top + i * pitch for i, (n, _) in enumerate(ins)}
        node.outs = {n: top + i * pitch for i, (n, _) in enumerate(outs)}
        if isinstance(self.table.blocks[path], Sum):
            node.outs = dict.fromkeys(node.outs, round(node.height / 2))
        return node

    def _closed_node(self, path: str) -> Node:
        ins, outs = self._pin_texts(path)
        rows = max(len(ins), len(outs), 1)
        sides = max((width(t, 8.5) for _, t in ins), default=0) + max((width(t, 8.5) for _, t in outs), default=0)
        node = Node(path, max(width(self._header(path), 10, True), sides + 16) + 24, 40.0 + rows * PIN)
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
        name, *rest = self._headings(path)
        more = f'<tspan fill="{GREY}" font-weight="normal"> · {escape(" · ".join(rest))}</tspan>' if rest else ""
        dash = ' stroke-dasharray="5 3"' if self.table.subsystems[path].control else ""
        return (
            f'<g><title>{escape(path)}</title><rect x="{x:g}" y="{y:g}" width="{w:g}" height="{h:g}" rx="5" '
            f'fill="{tint}" stroke="{BORDER}"{dash}/>\n'
            f'<text x="{x + 10:g}" y="{y + 16:g}" font-weight="bold">{escape(name)}{more}</text></g>\n'
        )

    def _block_shape(self, node: Node) -> str:
        path, x, y, w, h = node.key, node.x, node.y, node.width, node.height
        block = self.table.blocks[path]
        title, kind = self._titles(path)
        plant = block.stepped
        middle = x + w / 2
        out = [f"<g><title>{escape(path)}: {escape(kind)}</title>"]
        if isinstance(block, Sum):
            out.append(rect(x, y, w, h, "#ffffff", 12))
            out.append(text_at(middle + 4, y + h / 2 + 5, "Σ", 14, anchor="middle"))
        else:
            out.append(rect(x, y, w, h, PLANT if plant else "#ffffff", 3, 1.4 if plant else 1))
            if plant:
                out.append(rect(x + 2.5, y + 2.5, w - 5, h - 5, "none", 2, 0.7))
            named = any(t for pins in self._pin_texts(path) for _, t in pins)
            top = y + (16 if named else h / 2 - 2.5)
            out.append(text_at(middle, top, title, 10.5, anchor="middle", bold=True))
            out.append(text_at(middle, top + 11.5, kind, 8.5, anchor="middle", fill=GREY))
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

    def _wire(self, net: Net) -> str:
        out = [line(*net.runs)] if net.runs else []
        out += [f'<circle cx="{x:g}" cy="{y:g}" r="2.2" fill="{WIRE}"/>\n' for x, y in net.dots]
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
                out.append(f'<path d="M{x:g} {y:g}l-6.5 -3v6z" fill="{WIRE}"/>\n')
                part = self.nets.parts.get((item, pin))
                if part is not None:
                    out.append(text_at(x - 8, y - 3.5, part, 8, anchor="end", fill=GREY))
        return "".join(out)
