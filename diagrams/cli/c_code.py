"""The command that writes a sampled diagram as C for a target: ``loopwright c``."""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core import OptionError, explain_disk_errors
from ..exporting import to_c
from ..paper import Experiment
from ..wiring import Subsystem
from .command import Command, argument, flag, several
from .command_arguments import as_json
from .subjects import find_diagram
from .text import say, say_json
from .user_models import load_user_file


def _c(arguments: argparse.Namespace) -> int:
    """Carry out ``loopwright c``."""
    if arguments.test and not arguments.measure:
        raise OptionError("it is for --measure. Give both, or none.", port="--test")
    inputs = _read_signal(Path(arguments.test)) if arguments.test else {}
    code = _write(arguments)
    for file in code.files if not arguments.json else ():
        say(str(file))
    if arguments.measure:
        code.measure(inputs)
    if arguments.json:
        say_json({"files": list(code.files), "report": code.report.rstrip()})
        return 0
    say("")
    say(code.report.rstrip())
    return 0


def _write(arguments: argparse.Namespace) -> Any:
    options = {
        "name": arguments.name,
        "subsystem": arguments.subsystem,
        "outside": arguments.outside,
        "outputs": arguments.outputs,
        "number": arguments.number,
        "own_functions": arguments.own_functions,
    }
    with load_user_file(arguments.model, port="MODEL") as (module, path, name):
        found = vars(module).get(name)
        if not isinstance(found, Subsystem):
            found = find_diagram(vars(module), path, name)
        try:
            return to_c(found.diagram if isinstance(found, Experiment) else found, arguments.out, **options)
        except OptionError as error:
            if error.block == to_c.__name__ and error.port in options:  # by the option's name on the command line
                raise OptionError(error.message, port=f"--{error.port.replace('_', '-')}") from error
            raise


def _read_signal(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of a file by input; ``force[0]``, ``force[1]`` together are those of ``force``."""
    step = "Check the path."
    with explain_disk_errors(f"{str(path)!r} can't be read", path, step, OptionError, port="--test"):
        rows = [*csv.reader(path.read_text(encoding="utf-8").splitlines())]
    if len(rows) < 2:
        raise OptionError(f"found no row of numbers in {str(path)!r}; expected names, then numbers.", port="--test")
    try:
        table = np.array(rows[1:], dtype=float)
    except ValueError:
        raise OptionError(
            f"found something else than numbers below the names in {str(path)!r}; expected a number in each place.",
            port="--test",
        ) from None
    columns: dict[str, list[int]] = {}
    for i, name in enumerate(rows[0]):
        columns.setdefault(name.strip().partition("[")[0], []).append(i)
    vectors = {name.strip().partition("[")[0] for name in rows[0] if "[" in name}
    return {n: table[:, at] if n in vectors else table[:, at[0]] for n, at in columns.items()}


C = Command(
    name="c",
    help="write a sampled diagram or subsystem as C for a target",
    description="Write a sampled diagram or subsystem as C for a target: a header, a source of standard C99\n"
    "without allocation, an example, and a report of what each tick touches. No compiler is needed.\n\n"
    "MODEL is FILE.py:NAME: a diagram in a file of yours, a function that returns one, or a function with\n"
    "@subsystem, whose arguments become inputs.",
    examples=(
        "c loop.py:controller --out target",
        "c loop.py:loop --subsystem controller --number float --out target",
        "c loop.py:loop --outside plant --measure --test signal.csv",
    ),
    exit_status={
        0: "done",
        1: "it can't be C for a target, or the measurement failed",
        2: "wrong usage; nothing is written",
        130: "interrupted (Ctrl-C)",
    },
    arguments=(
        argument("model", metavar="MODEL", help="FILE.py:NAME"),
        argument("--out", metavar="DIR", default=".", help="folder for the files (default: the current folder)"),
        argument("--name", help="begin of all names in the C code (default: the subsystem's or diagram's)"),
        argument("--subsystem", metavar="PATH", help="write this subsystem of the diagram alone"),
        several("--outside", "PATH", "blocks of the diagram that are not written, such as the plant", default=[]),
        several("--outputs", "NAME", "signals that are outputs"),
        argument("--number", choices=("double", "float"), default="double", help="type of numbers"),
        flag("--own-functions", "elementary functions of Loopwright in place of math.h's"),
        flag("--measure", "compile it for Cortex-M4 and M0, and count the instructions of ticks"),
        argument(
            "--test",
            metavar="FILE.csv",
            help="test signal for --measure: a column for each input, such as force or force[1]; a row for each tick",
        ),
        as_json("the files and the report"),
    ),
    carry_out=_c,
)
