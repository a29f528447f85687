"""The command ``loopwright validate``."""

from __future__ import annotations

import argparse

from ...fmus.checks import validate
from .command import Command, argument, flag
from .command_arguments import as_json
from .text import check_file, say, say_json


def _validate(arguments: argparse.Namespace) -> int:
    """Carry out ``loopwright validate``."""
    path = check_file(arguments.file)
    report = validate(path, run=not arguments.no_run)
    if arguments.json:
        problems = [{"found": problem.found, "next": problem.step} for problem in report.problems]
        checked = {"checked": list(report.done), "not_checked": list(report.left)}
        say_json({"file": path, "clean": not problems, "problems": problems} | checked)
        return 1 if problems else 0
    n = len(report.problems)
    say(f"{path}: {'clean' if n == 0 else '1 problem' if n == 1 else f'{n} problems'}")
    for i, problem in enumerate(report.problems, 1):
        say(f"  {i}. {problem.found}")
        say(f"     Next: {problem.step}")
    if report.done:
        say(f"checked: {'; '.join(report.done)}")
    for line in report.left:
        say(f"not checked: {line}")
    if report.problems:
        say(f"These are departures from the standard. Whether it runs here all the same: loopwright doctor {path}")
    return 1 if report.problems else 0


VALIDATE = Command(
    name="validate",
    help="check an FMU and run it for some steps",
    description="Check an FMU of any tool: archive, description, model structure, binaries, sources; then run each "
    "interface\nfor some steps, in its own process.",
    examples=("validate plant.fmu", "validate plant.fmu --no-run"),
    exit_status="0 done, 1 problems were found, 2 wrong usage",
    arguments=(
        argument("file", metavar="FILE.fmu"),
        flag("--no-run", "don't run it: an FMU is a program of its maker's"),
        as_json("the problems, and what was checked,"),
    ),
    carry_out=_validate,
)
