"""The command ``loopwright page``: a diagram as a web page that runs."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...blocks.core import OptionError
from ..paper import experiments
from .subjects import open_user_diagram
from .text import add_json, say, say_json

if TYPE_CHECKING:
    from ..web_page import WebPage

_HAND = "hand"


def add_page(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``page`` to the parser of `main`."""
    page = commands.add_parser(
        "page",
        help="write a diagram as a web page that runs",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="DIAGRAM is FILE.py:NAME: a diagram in a file of yours, or a function without arguments that\n"
        "returns one; or hand: experiment C of the paper, guided by the pointer. One file, which opens from the disk:\n"
        "it runs in the browser, with sliders and plots.",
        epilog="examples:\n  loopwright page hand\n  loopwright page loop.py:loop --out loop.html\n"
        "  loopwright page loop.py:loop --input target=-100:100 --slider pid.kp=0:5 --plot speed,target --plot u\n"
        "\nexit status:\n  0    done\n  1    it can't be built: an FMU of others, a function of Python, no compiler\n"
        "  2    wrong usage; nothing was written\n  130  interrupted (Ctrl-C)",
    )
    page.add_argument("diagram", metavar="DIAGRAM", help="FILE.py:NAME, or hand")
    page.add_argument("--out", metavar="FILE.html", help="file (default: NAME.html)")
    for option, what in (("input", "a source that is moved by hand"), ("slider", "a parameter")):
        page.add_argument(
            f"--{option}",
            metavar="NAME[=LOW:HIGH]",
            action="append",
            default=[],
            dest=f"{option}s",
            help=f"{what}, with its range; repeat it for several",
        )
    page.add_argument(
        "--plot",
        metavar="NAME[,NAME]",
        action="append",
        default=[],
        dest="plots",
        help="signals of a plot; repeat it for several (default: the named wires)",
    )
    page.add_argument("--step", type=float, metavar="S", help="seconds between samples, where there is no clock")
    page.add_argument("--speed", type=float, default=1.0, metavar="X", help="times real time at first (default: 1)")
    add_json(page, "the file and its size")


def page_command(arguments: argparse.Namespace) -> int:
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
            low, high = (_number(end) for end in (ends.partition(":")[0], ends.partition(":")[2]))
            if not low < high:
                raise OptionError(f"found {text!r}; expected a range, such as {name}=0:5.", port=option)
            found[name] = (low, high)
    return found


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
