"""The command ``loopwright page``: a diagram as a web page that runs."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...blocks.core import OptionError
from ..paper import experiments
from .command import Argument, Command, argument, repeated
from .command_arguments import as_json
from .subjects import open_user_diagram
from .text import say, say_json

if TYPE_CHECKING:
    from ..web_page import WebPage

_HAND = "hand"


def _page(arguments: argparse.Namespace) -> int:
    """Carry out ``loopwright page``."""
    page, file = _make(arguments)
    if arguments.json:
        say_json({"file": file, "size": page.size})
    else:
        say(f"{file}: {page.size / 1e3:.0f} kB")
    return 0


def _make(arguments: argparse.Namespace) -> tuple[WebPage, Path]:
    if arguments.diagram == _HAND:
        out = Path(arguments.out or f"{_HAND}.html")
        return experiments.hand_page(out), out
    with open_user_diagram(arguments.diagram) as (diagram, _):
        options: dict[str, Any] = {"step": arguments.step, "speed": arguments.speed}
        if arguments.inputs:
            options["inputs"] = _ranges(arguments.inputs, "--input")
        if arguments.sliders:
            options["sliders"] = _ranges(arguments.sliders, "--slider")
        if arguments.plots:
            options["plots"] = [plot.split(",") for plot in arguments.plots]
        out = Path(arguments.out or f"{diagram.name}.html")
        return diagram.to_html(out, **options), out


def _ranges(given: list[str], option: str) -> dict[str, tuple[float, float] | None]:
    found: dict[str, tuple[float, float] | None] = {}
    for text in given:
        name, _, ends = text.partition("=")
        found[name] = None
        if ends:
            low, _, high = ends.partition(":")
            span = _number(low), _number(high)
            if not span[0] < span[1]:
                raise OptionError(f"found {text!r}; expected a range, such as {name}=0:5.", port=option)
            found[name] = span
    return found


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _ranged(name: str, noun: str) -> Argument:
    text = f"{noun}, with its range; repeat it for several"
    return repeated(f"--{name}", "NAME[=LOW:HIGH]", text, dest=f"{name}s")


PAGE = Command(
    name="page",
    help="write a diagram as a web page that runs",
    description="DIAGRAM is FILE.py:NAME: a diagram in a file of yours, or a function without arguments that\n"
    "returns one; or hand: experiment C of the paper, guided by the pointer. One file, which opens from the disk:\n"
    "it runs in the browser, with sliders and plots.",
    examples=(
        "page hand",
        "page loop.py:loop --out loop.html",
        "page loop.py:loop --input target=-100:100 --slider pid.kp=0:5 --plot speed,target --plot u",
    ),
    exit_status={
        0: "done",
        1: "it can't be built: an FMU of others, a function of Python, no compiler",
        2: "wrong usage; nothing was written",
        130: "interrupted (Ctrl-C)",
    },
    arguments=(
        argument("diagram", metavar="DIAGRAM", help="FILE.py:NAME, or hand"),
        argument("--out", metavar="FILE.html", help="file (default: NAME.html)"),
        _ranged("input", "a source that is moved by hand"),
        _ranged("slider", "a parameter"),
        repeated(
            "--plot",
            "NAME[,NAME]",
            "signals of a plot; repeat it for several (default: the named wires)",
            dest="plots",
        ),
        argument("--step", type=float, metavar="S", help="seconds between samples, where there is no clock"),
        argument("--speed", type=float, default=1.0, metavar="X", help="times real time at first (default: 1)"),
        as_json("the file and its size"),
    ),
    carry_out=_page,
    writes_at_the_end=True,
)
