"""The command line, ``loopwright``.

Exit status: 0 done, 1 a run or a build failed (its record is written) or an FMU has problems, 2 wrong usage,
130 interrupted.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from ...blocks.core import (
    FmuError,
    FmuFileError,
    LoopwrightError,
    OptionError,
    describe_disk_error,
    explain_disk_errors,
    write_text,
)
from ...fmus import Fmu
from ...fmus.child_processes import folder_in
from ...fmus.models import gantry
from ..paper import DEFINITIONS, EXPERIMENTS, Experiment, Theory, key_numbers, theory_numbers
from ..results import Run
from ..simulation import Interrupted
from .c_code import add_c, c_command
from .diagrams import add_diagram_options, add_diagrams, draw_command, run_diagram, sweep_command
from .fmu import COMMANDS, add_commands
from .options import option_lines, parse_letters, parse_options, parse_renames, share
from .page import add_page, page_command
from .report import add_report, report_command
from .ssp import add_ssp, ssp_command
from .subjects import is_user_file
from .text import fit as _fit
from .text import say as _say
from .unknown_options import check_command, explain_unknown

SIGNALS = (
    "eta",
    "xi",
    "position",
    "velocity",
    "force",
    "motor_force",
    "v_par",
    "v_perp",
    "theta",
    "q",
    "eta_p",
    "xi_p",
)
"""Signals of the CSV file, in order."""
HOLDS = "✓"
"""Mark of a closed form that holds."""
_AT_ONCE = ("build", "draw", "page", "ssp", "sweep")
"""Commands that write their file at the end, and all of it at once."""
_SHOWN = {"m": ("mm", 1e3), "1": ("%", 100.0), "m/s2": ("m/s²", 1.0)}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line with arguments, those of the process without them, and return the exit status."""
    parser = _make_parser()
    try:
        check_command(parser, sys.argv[1:] if argv is None else argv, [*_commands(parser)])
        arguments, unknown = parser.parse_known_args(argv)
        if unknown:
            explain_unknown(_find_command(parser, arguments.command), unknown)
    except SystemExit as stop:
        return int(stop.code or 0)
    if arguments.command is None:
        parser.print_help(sys.stderr)
        return 2
    try:
        own = {
            "report": report_command,
            "draw": draw_command,
            "sweep": sweep_command,
            "ssp": ssp_command,
            "page": page_command,
            "c": c_command,
        }
        return {**COMMANDS, **own}.get(arguments.command, _run)(arguments)
    except OptionError as error:
        _say(f"loopwright: error: {error}", sys.stderr)
        return 2
    except LoopwrightError as error:
        _say(f"loopwright: error: {error}", sys.stderr)
        return 1
    except KeyboardInterrupt:
        at_once = "; nothing is written" if arguments.command in _AT_ONCE else ""
        _say(f"loopwright: interrupted{at_once}.", sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of a pipe, such as head, has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python complains when it ends
        return 1


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="loopwright", description="Block diagrams and co-simulation for control engineers."
    )
    parser.add_argument("--version", action="version", version=f"loopwright {_version()}")
    commands = parser.add_subparsers(dest="command", metavar="command")
    width = max(len(name) for name in DEFINITIONS)
    run = commands.add_parser(
        "run",
        help="run a diagram of yours, or the experiments of the paper",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        usage="loopwright run FILE.py:NAME --duration S [options]\n       loopwright run [LETTER ...] [options]",
        description="Run a diagram of yours, FILE.py:NAME, where NAME may be a function that returns one. Writes all\n"
        "samples (NAME.csv), a summary (NAME.json) and a figure of the named wires (NAME.png, .svg) to the\n"
        "folder --out, and prints the named wires.\n\n"
        "Or run experiments of the paper: A path following, B compliance, C hand guiding, D force tracking.\n"
        "Writes the samples (A.csv), the key numbers (A.json, SI units) and two figures (A_path, A_signals;\n"
        ".png and .svg) of each, in place of an earlier run's. A run that fails writes its record until then, and the\n"
        'reason ("error" in A.json). A run without a record writes nothing, and an earlier run\'s files stay.',
        epilog="examples:\n  loopwright run loop.py:loop --duration 2\n"
        "  loopwright run loop.py:loop --duration 2 --set pid.kp=3 --json\n"
        "  loopwright run C --option tool_mass=0.3 --option delay=1\n\n"
        "options of experiments (--option), with their defaults:\n  "
        + "\n  ".join(option_lines())
        + "\n  An option that only some experiments have is given to those.\n\nkey numbers:\n"
        + "\n".join(f"  {name:{width}}  [{unit}] {text}" for name, (unit, text) in DEFINITIONS.items())
        + '\n  In A.json a number that does not exist is null; "never" lists the settling times without end.\n\n'
        "exit status:\n  0    done\n  1    a run failed, or a plant could not be built\n"
        "  2    wrong usage; nothing was run\n"
        "  130  interrupted (Ctrl-C); the record until then is written",
    )
    run.add_argument(
        "letters",
        nargs="*",
        metavar="FILE.py:NAME or LETTER",
        help="a diagram of yours, or A, B, C, D, also as A,B or AB; all four experiments without one",
    )
    run.add_argument("--out", metavar="DIR", default="out", help="folder for the files (default: out)")
    run.add_argument("--plant", metavar="FILE.fmu", help="another plant in place of the gantry")
    run.add_argument(
        "--rename",
        metavar="NAME=PORT",
        action="append",
        default=[],
        dest="renames",
        help="the plant's name of a port, and the name that Fig. 3 has for it, such as 's_y=position[1]'; repeat it "
        "for several",
    )
    run.add_argument(
        "--option",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        dest="options",
        help="an option of the experiments; repeat it for several",
    )
    add_diagram_options(run)
    add_diagrams(commands)
    add_report(commands)
    add_page(commands)
    add_c(commands)
    add_commands(commands)
    add_ssp(commands)
    return parser


def _find_command(parser: argparse.ArgumentParser, name: str | None) -> argparse.ArgumentParser:
    """Return the parser of a command, or that of the command line without one."""
    return parser if name is None else _commands(parser)[name]


def _commands(parser: argparse.ArgumentParser) -> Mapping[str, argparse.ArgumentParser]:
    """Return the parsers of all commands by their names."""
    groups = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    found: Mapping[str, argparse.ArgumentParser] = groups[0].choices
    return found


def _version() -> str:
    try:
        return version("loopwright")
    except PackageNotFoundError:
        return "(not installed)"


# --- files ----------------------------------------------------------------------------------------------------------


def _make_folder(name: str) -> Path:
    """Make the folder, and check that files can be written there."""
    folder = Path(name).expanduser()
    failed = f"nothing can be written to the folder {name!r}"
    with explain_disk_errors(failed, folder, "Name another folder.", OptionError, port="--out"):
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            pass
    return folder


# --- running --------------------------------------------------------------------------------------------------------


def _run(arguments: argparse.Namespace) -> int:
    """Build all experiments first, so that wrong usage is found before anything runs; then run them."""
    files = [given for given in arguments.letters if is_user_file(given)]
    if files:
        if len(arguments.letters) > 1:
            raise OptionError(f"found {' '.join(arguments.letters)}; expected one diagram. Run them one by one.")
        return run_diagram(files[0], arguments)
    for name, given in (("--duration", arguments.duration), ("--set", arguments.changes), ("--step", arguments.step)):
        if given:
            raise OptionError("it is for diagrams, FILE.py:NAME; experiments have --option.", port=name)
    letters = parse_letters(arguments.letters)
    chosen, renames = share(letters, parse_options(arguments)), parse_renames(arguments)
    try:
        for options in chosen.values() if renames else ():
            options["plant"] = Fmu(options["plant"], name="plant", rename=renames)
        if any(options.get("plant") is None for options in chosen.values()):
            gantry.build(notify=lambda line: _say(line, sys.stderr))
        experiments = [EXPERIMENTS[letter](**options) for letter, options in chosen.items()]
    except LoopwrightError as error:
        _say(f"loopwright: error: {error}", sys.stderr)
        return 1 if isinstance(error, FmuError) and not isinstance(error, FmuFileError) else 2
    # From here on one experiment that fails, or is interrupted, leaves the files of the others.
    folder = _make_folder(arguments.out)
    table: dict[str, dict[str, float | None]] = {}
    theory: dict[str, dict[str, Theory]] = {}
    written: list[list[str]] = []
    failed: dict[str, str] = {}
    interrupted = False
    for experiment in experiments:
        letter = experiment.letter
        run, problem, interrupted = _simulate(experiment)
        if run is not None and len(run.t):
            _say(f"{letter}: {run.t[-1]:g} s simulated in {run.elapsed:.2f} s", sys.stderr)
        if problem is not None:
            failed[letter] = problem
            _say(f"loopwright: experiment {letter} failed: {problem}", sys.stderr)
        if run is None or not len(run.t):
            _say(
                f"{letter}: nothing was recorded, so nothing is written{_earlier_files_text(letter, folder)}.",
                sys.stderr,
            )
        else:
            stay = _earlier_files_text(letter, folder)
            try:
                table[letter], names = _write(experiment, run, problem, folder)
                theory[letter] = theory_numbers(experiment, run)
                written.append(names)
            except OSError as error:
                found = describe_disk_error(error, folder, "Name another folder: --out.")
                failed[letter] = f"its files can't be written{stay}: {found}"
                _say(f"loopwright: experiment {letter}: {failed[letter]}", sys.stderr)
            except KeyboardInterrupt:
                interrupted = True
                _say(f"loopwright: interrupted; nothing of {letter} is written{stay}.", sys.stderr)
        if interrupted:
            break
    _print_table(table, failed, theory)
    if written:
        _say(f"Written to {folder}:")
    for names in written:
        _say(f"  {'  '.join(names)}")
    return 130 if interrupted else int(bool(failed))


def _simulate(experiment: Experiment) -> tuple[Run | None, str | None, bool]:
    """Run an experiment; return its run, the reason of a failure, and whether it was interrupted."""
    try:
        return experiment.simulate(), None, False
    except LoopwrightError as error:
        return getattr(error, "run", None), str(error), False
    except KeyboardInterrupt as interrupt:
        return interrupt.run if isinstance(interrupt, Interrupted) else None, "interrupted", True


def _write(
    experiment: Experiment, run: Run, problem: str | None, folder: Path
) -> tuple[dict[str, float | None], list[str]]:
    """Write all files of a run, in place of older ones all at once; return its key numbers and the files' names."""
    from ..paper import plot_experiment, plot_path
    from ..plotting import save

    letter = experiment.letter
    numbers = key_numbers(experiment, run)
    content: dict[str, Any] = {n: v if v is None or math.isfinite(v) else None for n, v in numbers.items()}
    content["never"] = [n for n, v in numbers.items() if v is not None and not math.isfinite(v)]
    if problem is not None:
        content["error"] = problem
    names = [file.name for file in _files(letter, folder)]
    with folder_in(folder, ".writing-") as new:
        run.to_csv(new / f"{letter}.csv", *SIGNALS)
        write_text(new / f"{letter}.json", json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n")
        for name, plot in (("path", plot_path), ("signals", plot_experiment)):
            save(plot(experiment, run, is_shown=False), new / f"{letter}_{name}")
        for name in names:
            (new / name).replace(folder / name)
    return numbers, names


def _files(letter: str, folder: Path) -> list[Path]:
    """Return the files that a run of an experiment writes."""
    figures = (f"_{kind}.{form}" for kind in ("path", "signals") for form in ("png", "svg"))
    return [folder / f"{letter}{ending}" for ending in (".csv", ".json", *figures)]


def _earlier_files_text(letter: str, folder: Path) -> str:
    """Return a remark that an earlier run's files stay, if there are any."""
    is_there = any(os.path.exists(file) for file in _files(letter, folder))
    return f"; the files of an earlier run stay in {folder}" if is_there else ""


# --- printing -------------------------------------------------------------------------------------------------------


def _print_table(
    table: Mapping[str, Mapping[str, float | None]],
    failed: Mapping[str, str],
    theory: Mapping[str, Mapping[str, Theory]],
) -> None:
    """Print the key numbers, one column for each experiment, and their closed forms, marked where they hold."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    if not table:
        return
    shown = Table(box=box.SIMPLE_HEAD, pad_edge=False, highlight=False)
    shown.add_column("key number", no_wrap=True)
    shown.add_column("unit", no_wrap=True)
    for letter in table:
        shown.add_column(f"{letter} failed" if letter in failed else letter, justify="right", no_wrap=True)
    shown.add_column("theory")
    mark = _fit(HOLDS, sys.stdout)
    for name, (unit, _) in DEFINITIONS.items():
        label, factor = ("", 1.0) if name == "real_time_factor" else _SHOWN.get(unit, (unit, 1.0))
        values = [_number_text(numbers[name], factor) for numbers in table.values()]
        known = {
            letter: (own[name], number)
            for letter, numbers in table.items()
            if name in (own := theory.get(letter, {})) and (number := numbers[name]) is not None
        }
        forms = (
            f"{letter}: {_number_text(form.value, factor)}{f' {mark}' if form.holds(number) else ''}"
            for letter, (form, number) in known.items()
        )
        if set(values) != {"-"}:
            shown.add_row(name, _fit(label, sys.stdout), *values, "\n".join(forms))
    console = Console(file=sys.stdout, width=None if sys.stdout.isatty() else 100, highlight=False)
    console.print(shown)
    if any(theory.values()):
        _say(f"theory: closed forms; {HOLDS} where the run is within 1 % of them")


def _number_text(value: float | None, factor: float) -> str:
    if value is None:
        return "-"
    return f"{value * factor:.4g}" if math.isfinite(value) else "never"
