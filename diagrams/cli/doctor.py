"""The command ``loopwright doctor``: whether an FMU runs here, and if not, what would help."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from ...fmus.archive import ArchiveLimits
from ...fmus.checks import doctor
from .command import Command, argument
from .command_arguments import as_json
from .text import check_file, say, say_json


def _doctor(arguments: argparse.Namespace) -> int:
    """Carry out ``loopwright doctor``."""
    path = Path(arguments.file).expanduser()
    usable = os.path.isfile(path)
    if not arguments.json:
        check_file(arguments.file)
    limits = None
    if arguments.max_size is not None:
        limits = ArchiveLimits(size=arguments.max_size * 1e9, ratio=float("inf"))
    diagnosis = doctor(path, run=arguments.run, limits=limits)
    if arguments.json:
        say_json(diagnosis.as_dict())
    else:
        say(str(diagnosis))
    if not usable:
        return 2
    return 0 if diagnosis.runs else 1


DOCTOR = Command(
    name="doctor",
    help="say whether an FMU runs here, and what would help",
    description="Examine an FMU of any tool: content, libraries for this machine, violations of the standard, a\n"
    "trial run of each interface in its own process, and a verdict in the first line.",
    examples=("doctor plant.fmu", "doctor plant.fmu --no-run --json"),
    exit_status="0 done: it runs here, or should; 1 it does not; 2 wrong usage",
    arguments=(
        argument("file", metavar="FILE.fmu"),
        argument(
            "--run",
            action=argparse.BooleanOptionalAction,
            help="try it, or don't: it is a program of its maker's, and may take a licence (default: try it, unless it "
            "says that it needs another program)",
        ),
        argument("--max-size", type=float, metavar="GB", help="unpacked size up to which it is read (default: 8)"),
        as_json("all of it"),
    ),
    carry_out=_doctor,
)
