"""The command ``loopwright sweep``."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core import OptionError, explain_disk_errors, near, replace_file
from ..diagram import Diagram
from .command import Command, argument, repeated
from .command_arguments import (
    DIAGRAM,
    DIAGRAM_TEXT,
    as_json,
    change_diagram,
    duration,
    given_options,
    parse_pairs,
    parse_value,
    set_parameters,
    solver,
    step,
)
from .subjects import open_user_diagram
from .text import finite_or_none, say, say_json

REDUCTIONS = ("final", "maximum", "minimum", "mean")
"""Numbers of a signal that a sweep takes."""


def _sweep(arguments: argparse.Namespace) -> int:
    """Carry out ``loopwright sweep``."""
    parameters, samples = _parse_varied(arguments.vary)
    if samples == "latin" and arguments.count is None:
        raise OptionError("ranges need the number of samples. Give it, such as --count 20.", port="--count")
    if samples == "grid" and arguments.count is not None:
        raise OptionError("it is for ranges; a list of values has its own number. Leave it out.", port="--count")
    with open_user_diagram(arguments.diagram) as (diagram, _):
        diagram = change_diagram(diagram, arguments)
        found = diagram.sweep(
            parameters,
            arguments.duration,
            samples=samples,
            count=arguments.count,
            seed=arguments.seed,
            reduce=_parse_reductions(arguments.reduce, diagram),
            workers=arguments.workers,
            **given_options(arguments),
        )
    columns, rows = _sweep_rows(found)
    if arguments.out is not None:
        out = Path(arguments.out).expanduser()
        with (
            explain_disk_errors(f"{str(out)!r} can't be written", out, "Name another file.", OptionError, port="--out"),
            replace_file(out) as part,
            open(part, "w", encoding="utf-8", newline="") as file,
        ):
            csv.writer(file).writerows([columns, *rows])
    if arguments.json:
        cells = ([finite_or_none(v) if isinstance(v, float) else v for v in row] for row in rows)
        say_json([dict(zip(columns, row, strict=True)) for row in cells])
    else:
        say(str(found))
    if arguments.out is not None and not arguments.json:
        say(f"\nWritten: {out}")
    return int(bool(found.failures))


def _parse_varied(given: Sequence[str]) -> tuple[dict[str, Any], str]:
    """Return the values or ranges of parameters, and the kind of samples that they ask for."""
    values: dict[str, Any] = {}
    kinds: set[str] = set()
    pairs = parse_pairs(given, "--vary", "PATH=VALUES", "pid.kp=1,2,5 or --vary pid.kp=1:10")
    for name, value in pairs.items():
        low, colon, high = value.partition(":")
        parts = [parse_value(part.strip()) for part in ((low, high) if colon else value.split(","))]
        if colon and not all(isinstance(part, int | float) and not isinstance(part, bool) for part in parts):
            raise OptionError(
                f"found {f'{name}={value}'!r}; expected a range of two numbers, such as {name}=1:10.", port="--vary"
            )
        kinds.add("latin" if colon else "grid")
        values[name] = tuple(parts)
    if len(kinds) > 1:
        raise OptionError(
            "found lists and ranges; expected one kind. Give all as lists, or all as ranges.", port="--vary"
        )
    return values, kinds.pop()


def _parse_reductions(given: Sequence[str], diagram: Diagram) -> dict[str, Any]:
    from ..sweeps import final, maximum, mean, minimum

    made = {"final": final, "maximum": maximum, "minimum": minimum, "mean": mean}
    if not given:
        return {name: final(name) for name in diagram.names}
    found = {}
    for text in given:
        kind, colon, signal = text.partition(":")
        if kind not in made or not colon or not signal:
            raise OptionError(
                f"found {text!r}; expected KIND:SIGNAL, such as maximum:y. {near(kind, made)}", port="--reduce"
            )
        found[f"{kind} {signal}"] = made[kind](signal)
    return found


def _sweep_rows(found: Any) -> tuple[list[str], list[list[Any]]]:
    """Return the columns and rows of a sweep's table: a vector's entries are columns; NaN where a run failed."""
    columns, values = ["sample", *found.samples.names], []
    for name in found.names:
        part = found[name].reshape(len(found.samples), -1)
        columns += [name] if part.shape[1] == 1 else [f"{name}[{k + 1}]" for k in range(part.shape[1])]
        values.append(part)
    table = np.hstack(values) if values else np.zeros((len(found.samples), 0))
    rows = zip(found.samples.rows, table, strict=True)
    return columns, [[k, *own, *map(float, row)] for k, (own, row) in enumerate(rows)]


SWEEP = Command(
    name="sweep",
    help="run a diagram with many values of parameters",
    description=DIAGRAM_TEXT + "It is run once for each sample of the parameters; a table has a row for each.",
    examples=(
        "sweep loop.py:loop --duration 2 --vary pid.kp=1,2,5 --reduce maximum:y",
        "sweep loop.py:loop --duration 2 --vary pid.kp=1:10 --vary pid.ki=0:3 --count 50 --out sweep.csv",
    ),
    exit_status={
        0: "done",
        1: "a run failed; the others are written",
        2: "wrong usage; nothing was run",
        130: "interrupted (Ctrl-C); nothing is written",
    },
    arguments=(
        DIAGRAM,
        duration("simulated time in s", required=True),
        repeated(
            "--vary",
            "PATH=VALUES",
            "values of a parameter, 1,2,5 (a grid), or a range, 1:10 (samples spread evenly in it, see --count); "
            "repeat it for several",
            required=True,
        ),
        argument("--count", type=int, metavar="N", help="number of samples of ranges"),
        argument("--seed", type=int, default=0, metavar="N", help="seed of the samples of ranges (default: 0)"),
        repeated(
            "--reduce",
            "KIND:SIGNAL",
            f"a number of each run: {', '.join(REDUCTIONS)} of a signal; repeat it for several (default: final of "
            "all named wires)",
        ),
        set_parameters(),
        step(),
        solver("solver of the continuous part"),
        argument("--workers", type=int, metavar="N", help="number of threads (default: as many as cores)"),
        argument("--out", metavar="FILE.csv", help="file for the table"),
        as_json("the table"),
    ),
    carry_out=_sweep,
    writes_at_the_end=True,
)
