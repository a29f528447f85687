"""The commands for diagrams of users: ``loopwright run FILE.py:NAME``, ``draw`` and ``sweep``."""

from __future__ import annotations

import argparse
import csv
import json
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...blocks.core import (
    LoopwrightError,
    OptionError,
    describe_disk_error,
    explain_disk_errors,
    near,
    replace_file,
    write_text,
)
from ...fmus.child_processes import folder_in
from ..diagram import Diagram
from ..results import Run
from ..simulation import Interrupted
from .options import parse_value
from .subjects import open_user_diagram, proposed
from .text import add_json, say, say_json

MOST_DRAWN = 12
"""Wires of a run's figure."""
REDUCTIONS = ("final", "maximum", "minimum", "mean")
"""Numbers of a signal that a sweep takes."""
_RAW = argparse.RawDescriptionHelpFormatter
_DIAGRAM = (
    "DIAGRAM is FILE.py:NAME: a diagram in a file of yours, or a function without arguments that returns one;\n"
    "or FILE.ssp, an SSP of any tool.\n"
)
_STATUS = (
    "\nexit status:\n  0    done\n  1    {one}\n  2    wrong usage; nothing was run\n"
    "  130  interrupted (Ctrl-C){interrupted}"
)


def add_diagram_options(run: argparse.ArgumentParser) -> None:
    """Add the options of ``loopwright run`` that are for diagrams of users."""
    group = run.add_argument_group("of FILE.py:NAME")
    group.add_argument("--duration", type=parse_positive, metavar="S", help="simulated time in s (experiments: theirs)")
    add_set(group)
    group.add_argument("--step", type=parse_positive, metavar="S", help="step between ticks, where there is no clock")
    group.add_argument("--solver", metavar="NAME", help="solver of the continuous part, such as RK45")
    add_json(group, "the results")


def add_diagrams(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``draw`` and ``sweep`` to the parser of `main`."""
    draw = commands.add_parser(
        "draw",
        help="draw a diagram",
        formatter_class=_RAW,
        description=_DIAGRAM + "It is drawn with its blocks, subsystems, rates and named wires.",
        epilog="examples:\n  loopwright draw loop.py:loop\n  loopwright draw loop.py:loop --out control.html "
        "--subsystem control\n" + _STATUS.format(one="the diagram can't be built", interrupted=""),
    )
    draw.add_argument("diagram", metavar="DIAGRAM", help="FILE.py:NAME")
    draw.add_argument("--out", metavar="FILE", help="file: .svg, .html, .png or .pdf (default: NAME.svg)")
    draw.add_argument("--subsystem", metavar="PATH", default="", help="draw the inside of this subsystem")
    draw.add_argument("--closed", action="store_true", help="draw all subsystems closed")
    add_json(draw, "the file, and the blocks and wires of the diagram,")
    sweep = commands.add_parser(
        "sweep",
        help="run a diagram with many values of parameters",
        formatter_class=_RAW,
        description=_DIAGRAM + "It is run once for each sample of the parameters; a table has a row for each.",
        epilog="examples:\n"
        "  loopwright sweep loop.py:loop --duration 2 --vary pid.kp=1,2,5 --reduce maximum:y\n"
        "  loopwright sweep loop.py:loop --duration 2 --vary pid.kp=1:10 --vary pid.ki=0:3 --count 50 --out sweep.csv\n"
        + _STATUS.format(one="a run failed; the others are written", interrupted="; nothing is written"),
    )
    sweep.add_argument("diagram", metavar="DIAGRAM", help="FILE.py:NAME")
    sweep.add_argument("--duration", type=parse_positive, metavar="S", required=True, help="simulated time in s")
    sweep.add_argument(
        "--vary",
        metavar="PATH=VALUES",
        action="append",
        default=[],
        required=True,
        help="values of a parameter, 1,2,5 (a grid), or a range, 1:10 (samples spread evenly in it, see --count); "
        "repeat it for several",
    )
    sweep.add_argument("--count", type=int, metavar="N", help="number of samples of ranges")
    sweep.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the samples of ranges (default: 0)")
    sweep.add_argument(
        "--reduce",
        metavar="KIND:SIGNAL",
        action="append",
        default=[],
        help=f"a number of each run: {', '.join(REDUCTIONS)} of a signal; repeat it for several (default: final of "
        "all named wires)",
    )
    add_set(sweep)
    sweep.add_argument("--step", type=parse_positive, metavar="S", help="step between ticks, where there is no clock")
    sweep.add_argument("--solver", metavar="NAME", help="solver of the continuous part")
    sweep.add_argument("--workers", type=int, metavar="N", help="number of threads (default: as many as cores)")
    sweep.add_argument("--out", metavar="FILE.csv", help="file for the table")
    add_json(sweep, "the table")


def add_set(parser: Any) -> None:
    """Add the option of other values of parameters."""
    parser.add_argument(
        "--set",
        metavar="PATH=VALUE",
        action="append",
        default=[],
        dest="changes",
        help="another value of a parameter, such as pid.kp=3; repeat it for several",
    )


def parse_positive(text: str) -> float:
    """Return a positive number that was given as a text."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"found {text!r}; expected a positive number")
    return value


# --- run ------------------------------------------------------------------------------------------------------------


def run_diagram(subject: str, arguments: argparse.Namespace) -> int:
    """Carry out ``loopwright run FILE.py:NAME``."""
    for name, given in (("--option", arguments.options), ("--plant", arguments.plant), ("--rename", arguments.renames)):
        if given:
            raise OptionError("it is for experiments; write --set PATH=VALUE for a diagram.", port=name)
    out = Path(arguments.out).expanduser()
    with explain_disk_errors(
        f"nothing can be written to {str(out)!r}", out, "Name another folder.", OptionError, port="--out"
    ):
        out.mkdir(parents=True, exist_ok=True)
    try:
        with open_user_diagram(subject) as (diagram, experiment):
            diagram = change_diagram(diagram, arguments)
            file = proposed(subject)
            duration = arguments.duration or (file.get("duration") if experiment is None else experiment.duration)
            if duration is None:
                raise OptionError(
                    "a diagram has none of its own. Give it in s, such as --duration 2.", port="--duration"
                )
            run, problem, interrupted = _simulate(diagram, duration, _run_options(arguments, file))
            if run is not None and len(run.t):
                files = _write_run(diagram.name, run, problem, out)
    except OptionError:
        raise
    except LoopwrightError as error:
        say(f"loopwright: error: {error}", sys.stderr)
        return 1
    if problem is not None:
        say(f"loopwright: {'' if interrupted else 'error: '}{problem}", sys.stderr)
    if run is None or not len(run.t):
        say("loopwright: nothing was recorded, so nothing is written.", sys.stderr)
    elif arguments.json:
        say_json(_facts(run, problem) | {"files": [str(file) for file in files]})
    else:
        say(str(run))
        say(f"\nWritten: {'  '.join(map(str, files))}")
    return 130 if interrupted else int(problem is not None)


def change_diagram(diagram: Diagram, arguments: argparse.Namespace) -> Diagram:
    """Return a diagram with the parameters that ``--set`` gives."""
    changes: dict[str, Any] = {}
    for text in arguments.changes:
        name, value = _split(text, "--set", "pid.kp=3")
        if name in changes:
            raise OptionError(f"{name} is given twice; give it once.", port="--set")
        changes[name] = parse_value(value)
    if not changes:
        return diagram
    try:
        return diagram.replace(changes)
    except LoopwrightError as error:
        raise OptionError(str(error), port="--set") from error


def _split(text: str, port: str, example: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals or not name.strip() or not value.strip():
        raise OptionError(f"found {text!r}; expected PATH=VALUE, such as {port} {example}.", port=port)
    return name.strip(), value.strip()


def _run_options(arguments: argparse.Namespace, file: Mapping[str, float] | None = None) -> dict[str, Any]:
    given = {name: value for name in ("step", "solver") if (value := getattr(arguments, name)) is not None}
    return {**({"step": file["step"]} if file and "step" in file else {}), **given}


def _simulate(diagram: Diagram, duration: float, options: Mapping[str, Any]) -> tuple[Run | None, str | None, bool]:
    """Run a diagram; return its run, the reason of a failure, and whether it was interrupted."""
    try:
        return diagram.simulate(duration, **options), None, False
    except OptionError:
        raise
    except LoopwrightError as error:
        return getattr(error, "run", None), str(error), False
    except KeyboardInterrupt as interrupt:
        run = interrupt.run if isinstance(interrupt, Interrupted) else None
        return run, "interrupted; the record until then is written.", True


def _facts(run: Run, problem: str | None) -> dict[str, Any]:
    """Return a run as JSON has it: the samples are in the CSV file."""
    signals = {}
    for name in run.names:
        if name in run.wires:
            values = run[name]
            low, high, end = map(_finite, (values.min(axis=0), values.max(axis=0), values[-1]))
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


def _finite(value: Any) -> Any:
    """Return a number, or an array as lists, with None where it is not finite: JSON has no other word."""
    if np.ndim(value):
        return [_finite(one) for one in value]
    return float(value) if math.isfinite(value) else None


def _write_run(name: str, run: Run, problem: str | None, folder: Path) -> list[Path]:
    """Write the samples, the facts and a figure of the named wires; they replace an earlier run's all together."""
    from ..plotting import new_figure, save

    drawn = [wire for wire in run.wires if wire in run.names][:MOST_DRAWN]
    try:
        with folder_in(folder, ".writing-") as new:
            run.to_csv(new / f"{name}.csv")
            write_text(new / f"{name}.json", json.dumps(_facts(run, problem), indent=2) + "\n")
            if drawn:
                figure = new_figure(0.5 + 1.35 * len(drawn))
                axes = list(figure.subplots(len(drawn), 1, sharex=True, squeeze=False)[:, 0])
                save(run.plot(*drawn, axes=axes), new / name)
            made = sorted(file.name for file in new.iterdir())
            for file in made:
                (new / file).replace(folder / file)
    except OSError as error:
        found = describe_disk_error(error, folder, "Name another folder: --out.")
        raise OptionError(f"its files can't be written: {found}", port="--out") from error
    return [folder / file for file in made]


# --- draw -----------------------------------------------------------------------------------------------------------


def draw_command(arguments: argparse.Namespace) -> int:
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


# --- sweep ----------------------------------------------------------------------------------------------------------


def sweep_command(arguments: argparse.Namespace) -> int:
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
            **_run_options(arguments),
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
        cells = ([_finite(v) if isinstance(v, float) else v for v in row] for row in rows)
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
    for text in given:
        name, value = _split(text, "--vary", "pid.kp=1,2,5 or pid.kp=1:10")
        if name in values:
            raise OptionError(f"{name} is given twice; give it once.", port="--vary")
        low, colon, high = value.partition(":")
        parts = [parse_value(part.strip()) for part in ((low, high) if colon else value.split(","))]
        if colon and not all(isinstance(part, int | float) and not isinstance(part, bool) for part in parts):
            raise OptionError(f"found {text!r}; expected a range of two numbers, such as {name}=1:10.", port="--vary")
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
