"""``loopwright run FILE.py:NAME``: a run of a user's diagram, and its files."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from ...blocks.core import LoopwrightError, OptionError, describe_disk_error, write_text
from ..results import Run
from .command_arguments import change_diagram, given_options
from .record import make_folder, record, replace_files
from .subjects import open_user_diagram, proposed
from .text import finite_or_none, say, say_json

MOST_DRAWN = 12
"""Wires of a run's figure."""
INTERRUPTED = "interrupted; the record until then is written."


def run_diagram(subject: str, arguments: argparse.Namespace) -> int:
    """Run a diagram, write its files and print its named wires; return the exit status."""
    folder = make_folder(arguments.out)
    files: list[Path] = []
    try:
        with open_user_diagram(subject) as (diagram, experiment):
            diagram = change_diagram(diagram, arguments)
            file = proposed(subject)
            duration = arguments.duration or (file.get("duration") if experiment is None else experiment.duration)
            if duration is None:
                raise OptionError(
                    "a diagram has none of its own. Give it in s, such as --duration 2.", port="--duration"
                )
            options = {name: file[name] for name in ("step",) if name in file} | given_options(arguments)
            recorded = record(lambda: diagram.simulate(duration, **options), raised=(OptionError,))
            run, problem = recorded.run, INTERRUPTED if recorded.is_interrupted else recorded.problem
            if run is not None and recorded.samples:
                files = _write(diagram.name, run, problem, folder)
    except OptionError:
        raise
    except LoopwrightError as error:
        say(f"loopwright: error: {error}", sys.stderr)
        return 1
    if problem is not None:
        say(f"loopwright: {'' if recorded.is_interrupted else 'error: '}{problem}", sys.stderr)
    if run is None or not files:
        say("loopwright: nothing was recorded, so nothing is written.", sys.stderr)
    elif arguments.json:
        say_json(_facts(run, problem) | {"files": [str(file) for file in files]})
    else:
        say(str(run))
        say(f"\nWritten: {'  '.join(map(str, files))}")
    return recorded.exit_status


def _facts(run: Run, problem: str | None) -> dict[str, Any]:
    """Return a run as JSON has it: the samples are in the CSV file."""
    signals = {}
    for name in run.names:
        if name in run.wires:
            values = run[name]
            low, high, end = map(finite_or_none, (values.min(axis=0), values.max(axis=0), values[-1]))
            signals[name] = {"unit": run.unit(name), "minimum": low, "maximum": high, "end": end}
    stopped = None if run.stopped is None else {"t": run.stopped.t, "block": run.stopped.block}
    return {
        "diagram": run.diagram_name,
        "from": float(run.t[0]),
        "to": float(run.t[-1]),
        "samples": len(run.t),
        "signals": signals,
        "events": len(run.events),
        "stopped": stopped,
        "messages": list(run.messages),
        "error": problem,
    }


def _write(name: str, run: Run, problem: str | None, folder: Path) -> list[Path]:
    """Write the samples, the facts and a figure of the named wires, in place of an earlier run's; return the files."""
    from ..plotting import new_figure, save

    drawn = [wire for wire in run.wires if wire in run.names][:MOST_DRAWN]
    try:
        with replace_files(folder) as new:
            run.to_csv(new / f"{name}.csv")
            write_text(new / f"{name}.json", json.dumps(_facts(run, problem), indent=2) + "\n")
            if drawn:
                figure = new_figure(0.5 + 1.35 * len(drawn))
                axes = list(figure.subplots(len(drawn), 1, sharex=True, squeeze=False)[:, 0])
                save(run.plot(*drawn, axes=axes), new / name)
            made = sorted(file.name for file in new.iterdir())
    except OSError as error:
        found = describe_disk_error(error, folder, "Name another folder: --out.")
        raise OptionError(f"its files can't be written: {found}", port="--out") from error
    return [folder / file for file in made]
