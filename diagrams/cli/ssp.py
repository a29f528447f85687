"""The command ``loopwright ssp``, which writes a diagram as an SSP; SSPs as subjects of the other commands."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from ..ssp import SspDescription, read_ssp
from .command import Command, argument, flag
from .command_arguments import DIAGRAM, as_json, change_diagram, parse_positive, set_parameters
from .subjects import open_user_diagram, split_ssp
from .text import say, say_json


def _ssp(arguments: argparse.Namespace) -> int:
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


SSP = Command(
    name="ssp",
    help="write a diagram of FMUs as an SSP",
    description="DIAGRAM is FILE.py:NAME: a diagram in a file of yours. It is written as an SSP (System Structure\n"
    "and Parameterization): FMUs, connections, parameter sets, and a layout.\n\n"
    "The other way, an SSP of any tool is a diagram for 'run', 'draw' and 'sweep', FILE.ssp or\n"
    "FILE.ssp:VARIANT.ssd, and 'inspect' says what is in it.",
    examples=(
        "ssp loop.py:loop --out loop.ssp --stop 10",
        "inspect loop.ssp",
        "run loop.ssp --duration 2 --step 0.01",
    ),
    exit_status="0 done, 1 it has no place in an SSP, 2 wrong usage",
    arguments=(
        DIAGRAM,
        argument("--out", metavar="FILE.ssp", help="file (default: NAME.ssp)"),
        argument("--stop", type=parse_positive, metavar="S", help="proposed end of a simulation, in s"),
        argument("--step", type=parse_positive, metavar="S", help="proposed communication step, in s"),
        flag("--flat", "one level without inputs and outputs, for readers that know no more"),
        set_parameters(),
        as_json("the file and its content"),
    ),
    carry_out=_ssp,
    writes_at_the_end=True,
)
