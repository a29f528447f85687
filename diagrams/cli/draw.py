"""The command ``loopwright draw``."""

from __future__ import annotations

import argparse
from pathlib import Path

from .command import Command, argument, flag
from .command_arguments import DIAGRAM, DIAGRAM_TEXT, as_json
from .subjects import open_user_diagram
from .text import say, say_json


def _draw(arguments: argparse.Namespace) -> int:
    """Carry out ``loopwright draw``."""
    with open_user_diagram(arguments.diagram) as (diagram, _):
        out = Path(arguments.out or f"{diagram.name}.svg").expanduser()
        diagram.draw(out, subsystem=arguments.subsystem, closed=True if arguments.closed else None)
        if arguments.json:
            blocks = {path: type(block).__name__ for path, block in diagram.blocks.items()}
            wires = [{"from": str(wire), "to": f"{path}.{port}"} for (path, port), wire in diagram.wires.items()]
            names = {name: str(wire) for name, wire in diagram.names.items()}
            say_json({"file": out, "diagram": diagram.name, "blocks": blocks, "wires": wires, "names": names})
        else:
            say(f"Written: {out}")
    return 0


DRAW = Command(
    name="draw",
    help="draw a diagram",
    description=DIAGRAM_TEXT + "It is drawn with its blocks, subsystems, rates and named wires.",
    examples=("draw loop.py:loop", "draw loop.py:loop --out control.html --subsystem control"),
    exit_status={
        0: "done",
        1: "the diagram can't be built",
        2: "wrong usage; nothing was run",
        130: "interrupted (Ctrl-C)",
    },
    arguments=(
        DIAGRAM,
        argument("--out", metavar="FILE", help="file: .svg, .html, .png or .pdf (default: NAME.svg)"),
        argument("--subsystem", metavar="PATH", default="", help="draw the inside of this subsystem"),
        flag("--closed", "draw all subsystems closed"),
        as_json("the file, and the blocks and wires of the diagram,"),
    ),
    carry_out=_draw,
    writes_at_the_end=True,
)
