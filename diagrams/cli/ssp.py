"""The command ``loopwright ssp``, which writes a diagram as an SSP; SSPs as subjects of the other commands."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from ..ssp import SspDescription, read_ssp
from .diagrams import add_set, change_diagram, parse_positive
from .subjects import open_user_diagram, split_ssp
from .text import add_json, say, say_json


def add_ssp(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command to the parser of `main`."""
    made = commands.add_parser(
        "ssp",
        help="write a diagram of FMUs as an SSP",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="DIAGRAM is FILE.py:NAME: a diagram in a file of yours. It is written as an SSP (System Structure\n"
        "and Parameterization): FMUs, connections, parameter sets, and a layout.\n\n"
        "The other way, an SSP of any tool is a diagram for 'run', 'draw' and 'sweep', FILE.ssp or\n"
        "FILE.ssp:VARIANT.ssd, and 'inspect' says what is in it.",
        epilog="examples:\n  loopwright ssp loop.py:loop --out loop.ssp --stop 10\n  loopwright inspect loop.ssp\n"
        "  loopwright run loop.ssp --duration 2 --step 0.01\n"
        "\nexit status: 0 done, 1 it has no place in an SSP, 2 wrong usage",
    )
    made.add_argument("diagram", metavar="DIAGRAM", help="FILE.py:NAME")
    made.add_argument("--out", metavar="FILE.ssp", help="file (default: NAME.ssp)")
    made.add_argument("--stop", type=parse_positive, metavar="S", help="proposed end of a simulation, in s")
    made.add_argument("--step", type=parse_positive, metavar="S", help="proposed communication step, in s")
    made.add_argument(
        "--flat", action="store_true", help="one level without inputs and outputs, for readers that know no more"
    )
    add_set(made)
    add_json(made, "the file and its content")


def ssp_command(arguments: argparse.Namespace) -> int:
    """Carry out ``loopwright ssp``."""
    with open_user_diagram(arguments.diagram) as (diagram, _):
        changed = change_diagram(diagram, arguments)
        file = Path(arguments.out or f"{changed.name}.ssp").expanduser()
        written = changed.to_ssp(file, stop=arguments.stop, step=arguments.step, flat=arguments.flat)
    about = read_ssp(written)
    if arguments.json:
        say_json({"file": written} | _facts(about))
        return 0
    say(f"{written}  ({written.stat().st_size / 1e3:.1f} kB)")
    say(f"SSP {about.version}, {len(about.components)} components")
    return 0


def inspect_ssp(name: str, *, as_json: bool) -> int:
    """Carry out ``loopwright inspect FILE.ssp``."""
    file, variant = split_ssp(name)
    about = read_ssp(file, variant)
    if as_json:
        say_json(_facts(about))
    else:
        say(str(about))
    return 0


def _facts(about: SspDescription) -> dict[str, Any]:
    found = {f.name: getattr(about, f.name) for f in dataclasses.fields(about) if not f.name.startswith("_")}
    return {**found, "file": str(about.file)}
