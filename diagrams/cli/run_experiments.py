"""``loopwright run LETTER``: experiments of the paper, their files and the table of their key numbers."""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...blocks.core import FmuError, FmuFileError, LoopwrightError, describe_disk_error, write_text
from ...fmus import Fmu
from ...fmus.models import gantry
from ..paper import DEFINITIONS, EXPERIMENTS, Experiment, Theory, key_numbers, theory_numbers
from ..results import Run
from .options_of_experiments import parse_letters, parse_options, parse_renames, share
from .record import make_folder, record, replace_files
from .text import fit, say

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
_SHOWN = {"m": ("mm", 1e3), "1": ("%", 100.0), "m/s2": ("m/s²", 1.0)}
"""Units of key numbers as the table shows them, with a factor."""


def run_experiments(given: Sequence[str], arguments: argparse.Namespace) -> int:
    """Build all experiments first, so that wrong usage is found before anything runs; then run them."""
    letters = parse_letters(given)
    chosen, renames = share(letters, parse_options(arguments)), parse_renames(arguments)
    try:
        for options in chosen.values() if renames else ():
            options["plant"] = Fmu(options["plant"], name="plant", rename=renames)
        if any(options.get("plant") is None for options in chosen.values()):
            gantry.build(notify=lambda line: say(line, sys.stderr))
        experiments = [EXPERIMENTS[letter](**options) for letter, options in chosen.items()]
    except LoopwrightError as error:
        say(f"loopwright: error: {error}", sys.stderr)
        return 1 if isinstance(error, FmuError) and not isinstance(error, FmuFileError) else 2
    # From here on one experiment that fails, or is interrupted, leaves the files of the others.
    folder = make_folder(arguments.out)
    table: dict[str, dict[str, float | None]] = {}
    theory: dict[str, dict[str, Theory]] = {}
    written: list[list[str]] = []
    failed: dict[str, str] = {}
    interrupted = False
    for experiment in experiments:
        letter = experiment.letter
        recorded = record(experiment.simulate)
        run, problem, interrupted = recorded.run, recorded.problem, recorded.is_interrupted
        if run is not None and len(run.t):
            say(f"{letter}: {run.t[-1]:g} s simulated in {run.elapsed:.2f} s", sys.stderr)
        if problem is not None:
            failed[letter] = problem
            say(f"loopwright: experiment {letter} failed: {problem}", sys.stderr)
        if run is None or not len(run.t):
            say(
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
                say(f"loopwright: experiment {letter}: {failed[letter]}", sys.stderr)
            except KeyboardInterrupt:
                interrupted = True
                say(f"loopwright: interrupted; nothing of {letter} is written{stay}.", sys.stderr)
        if interrupted:
            break
    _print_table(table, failed, theory)
    if written:
        say(f"Written to {folder}:")
    for names in written:
        say(f"  {'  '.join(names)}")
    return 130 if interrupted else int(bool(failed))


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
    with replace_files(folder) as new:
        run.to_csv(new / f"{letter}.csv", *SIGNALS)
        write_text(new / f"{letter}.json", json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False) + "\n")
        for name, plot in (("path", plot_path), ("signals", plot_experiment)):
            save(plot(experiment, run, is_shown=False), new / f"{letter}_{name}")
    return numbers, [file.name for file in _files(letter, folder)]


def _files(letter: str, folder: Path) -> list[Path]:
    """Return the files that a run of an experiment writes."""
    figures = (f"_{kind}.{form}" for kind in ("path", "signals") for form in ("png", "svg"))
    return [folder / f"{letter}{ending}" for ending in (".csv", ".json", *figures)]


def _earlier_files_text(letter: str, folder: Path) -> str:
    """Return a remark that an earlier run's files stay, if there are any."""
    is_there = any(os.path.exists(file) for file in _files(letter, folder))
    return f"; the files of an earlier run stay in {folder}" if is_there else ""


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
    mark = fit(HOLDS, sys.stdout)
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
            shown.add_row(name, fit(label, sys.stdout), *values, "\n".join(forms))
    console = Console(file=sys.stdout, width=None if sys.stdout.isatty() else 100, highlight=False)
    console.print(shown)
    if any(theory.values()):
        say(f"theory: closed forms; {HOLDS} where the run is within 1 % of them")


def _number_text(value: float | None, factor: float) -> str:
    if value is None:
        return "-"
    return f"{value * factor:.4g}" if math.isfinite(value) else "never"
