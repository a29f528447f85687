"""The command ``loopwright inspect``: the description of an FMU or an SSP."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from ...fmus.checks import INTERFACES, summarize
from .command import Command, argument, flag
from .command_arguments import as_json
from .ssp import inspect_ssp
from .subjects import is_ssp
from .text import check_file, fit, say, say_json, size_text

_WIDTH = 120  # of a table that goes into a file
_MOST = 6  # numbers of a start value that are shown
_SHOWN = {"parameter", "structuralParameter", "calculatedParameter", "input", "output"}


def _inspect(arguments: argparse.Namespace) -> int:
    """Carry out ``loopwright inspect``."""
    if is_ssp(arguments.file):
        return inspect_ssp(arguments.file, as_json=arguments.json)
    path = check_file(arguments.file)
    summary = summarize(path)
    if arguments.json:
        say_json(summary)
        return 0
    for label, text in _summary_lines(summary):
        say(f"{label:<15}{text}")
    for note in summary["notes"]:
        say(f"{'note':<15}{note}")
    _print_variables(summary["variables"], everything=arguments.all)
    return 0


def _summary_lines(s: Mapping[str, Any]) -> Iterable[tuple[str, str]]:
    """Yield label and text of each line; lines without a label continue the one before."""
    # What it is, and who made it.
    version = f", version {s['version']}" if s["version"] else ""
    yield "model", f"{s['model_name']}{version}"
    if s["description"]:
        yield "", s["description"]
    made = f", {s['generation_date_and_time']}" if s["generation_date_and_time"] else ""
    yield "made by", f"{s['generation_tool'] or '(not said)'}{made}"
    for key in ("author", "license", "copyright"):
        if s[key]:
            yield key, s[key]
    yield "file", f"{s['file']}  ({size_text(s['size'])})"
    yield "SHA-256", s["sha256"]
    yield "FMI", s["fmi_version"]
    for kind, attributes in s["interfaces"].items():
        flags = [
            name if value is True else f"{name} = {value}"
            for name, value in attributes.items()
            if value is not False and name != "modelIdentifier"
        ]
        yield "interface", INTERFACES[kind]
        for line in flags or ["no capability flags"]:
            yield "", f"  {line}"
    if s["default_experiment"]:
        given = s["default_experiment"]
        text = [f"{key.replace('_', ' ')} {value}{'' if key == 'tolerance' else ' s'}" for key, value in given.items()]
        yield "experiment", ", ".join(text)
    # Where it runs.
    yield "platforms", ", ".join(s["platforms"]) or "none"
    native = s["native"]
    state = "there is a binary" if native["available"] else "no binary"
    yield "this machine", f"{native['platform']}: {state}"
    if native["missing_libraries"]:
        missing = ", ".join(native["missing_libraries"])
        yield "", f"its binary needs libraries that are missing here: {missing}. Install them."
    elif native["undefined_symbols"]:
        first, n = native["undefined_symbols"][0], len(native["undefined_symbols"])
        more = f" and {n - 1} more" if n > 1 else ""
        yield "", f"its binary takes symbols from the program that loads it: {first}{more}"
    yield "sources", f"{len(s['sources'])} files" if s["sources"] else "none"
    # What is in it.
    counts = Counter(v["causality"] for v in s["variables"])
    yield "variables", ", ".join(f"{n} {name}" for name, n in counts.items()) or "none"
    yield "states", f"{s['continuous_states']} continuous; {s['event_indicators']} event indicators"


def _print_variables(variables: Iterable[Mapping[str, Any]], *, everything: bool) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    chosen, hidden = [], Counter[str]()
    for v in variables:
        if everything or v["causality"] in _SHOWN or v["state"]:
            chosen.append(v)
        else:
            hidden[v["causality"]] += 1
    if chosen:
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, highlight=False)
        for column in ("name", "type", "shape", "causality", "variability", "unit", "start", "description"):
            table.add_column(column, overflow="fold", no_wrap=column not in ("name", "start", "description"))
        for v in chosen:
            causality = f"{v['causality']}, state" if v["state"] else v["causality"]
            shape = "×".join("?" if n is None else str(n) for n in v["shape"])
            cells = (
                v["name"],
                v["type"],
                shape,
                causality,
                v["variability"] or "",
                v["unit"] or "",
                _start_text(v["start"]),
                v["description"],
            )
            table.add_row(*(Text(fit(cell, sys.stdout)) for cell in cells))
        Console(file=sys.stdout, width=None if sys.stdout.isatty() else _WIDTH, highlight=False).print(table)
    if hidden:
        say(f"not shown: {', '.join(f'{n} {name}' for name, n in hidden.items())}; --all shows them.")


def _start_text(value: Any) -> str:
    if value is None:
        return ""
    values = value if isinstance(value, list) else [value]
    text = ", ".join(f"{v:.9g}" if isinstance(v, float) else str(v) for v in values[:_MOST])
    return f"{text}, … ({len(values)})" if len(values) > _MOST else text


INSPECT = Command(
    name="inspect",
    help="show the description of an FMU or an SSP",
    description="Show the description of an FMU of any tool (FMI 1.0 to 3.0), or of an SSP, without running it.",
    examples=("inspect plant.fmu", "inspect plant.fmu --json", "inspect system.ssp"),
    exit_status="0 done, 1 it can't be read, 2 wrong usage",
    arguments=(
        argument("file", metavar="FILE", help="a .fmu, .ssp or .ssd"),
        flag("--all", "local variables, too"),
        as_json("the same, with all variables,"),
    ),
    carry_out=_inspect,
)
