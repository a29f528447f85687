"""The command ``loopwright report``."""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...blocks.core import (
    FmuError,
    FmuFileError,
    LoopwrightError,
    OptionError,
    UnknownNameError,
    describe_disk_error,
)
from ..diagram import Diagram
from ..paper import Experiment
from ..requirements import (
    STUDIES,
    Reason,
    RequirementResult,
    Requirements,
    Review,
    TomlFile,
    Verdict,
    explain,
    read_requirements,
)
from ..simulation import work_notes
from .command import Command, argument, flag, repeated
from .command_arguments import PLANT, experiment_option, parse_pairs
from .subjects import open_subject
from .text import say

if TYPE_CHECKING:
    from ..report import Report
    from ..studies import ContactTask, WorstCaseTask

KEY, CONTACT = "worst_case", "contact"
"""Tables of a worst case, and of contacts."""
SAID = {KEY: "a worst case", CONTACT: "contacts"}
"""Contents of the tables in words."""
ABOUT = ("title", "author", "project", "date")
"""Lines of the heading that the command line can give."""
EXIT_STATUS = {Verdict.PASSED: 0, Verdict.FAILED: 3, Verdict.UNDECIDED: 4}
"""Exit status of ``--check``."""
NARROW = "\u202f"
"""Narrow space between a number and its unit on the page."""
TRIM = "trim"
"""Word of ``--at`` for a point at which all is at rest."""
DEFAULT = "B"
"""The experiment whose Fig. 3 is taken: both admittances are in it."""


def _report(arguments: argparse.Namespace) -> int:
    """Make the diagram, analyse it, write the files; return the exit status."""
    from ..report import check_files, write_report

    # All arguments and files are read and checked first: an analysis takes seconds to minutes.
    file = None if arguments.requirements is None else TomlFile.read(arguments.requirements, "--requirements")
    asked = None if file is None else read_requirements(file)
    searched = _read_worst_case(arguments.worst_case, file)
    touched = _read_contacts(arguments.contact, file)
    if arguments.check and asked is None and not (touched is not None and touched.limits):
        raise OptionError("there is nothing to check. Give the file: --requirements loop.toml.", port="--check")
    measured = _read_measured(arguments.measured)
    subject = arguments.diagram or DEFAULT
    with contextlib.ExitStack() as open_file:
        try:
            diagram, experiment = open_file.enter_context(open_subject(subject, arguments))
        except OptionError:
            raise
        except LoopwrightError as error:
            say(f"loopwright: error: {error}", sys.stderr)
            return 1 if isinstance(error, FmuError) and not isinstance(error, FmuFileError) else 2
        out = arguments.out or (f"{diagram.name}.html" if arguments.diagram else "fig3.html")
        check_files(out, pdf=arguments.pdf, json=arguments.json)
        if searched is not None:
            searched.check(diagram.wired, asked)
        if touched is not None:
            touched.find(diagram.wired)
        began = time.perf_counter()
        about = {name: text for name in ABOUT if (text := getattr(arguments, name)) is not None}
        try:
            with work_notes(diagram.name) as progress:
                report = _analyse(diagram, experiment, arguments, asked, about, progress, measured, searched, touched)
        # A name in the requirements or measured files is wrong usage (2); one inside the analysis is a failure (1).
        except UnknownNameError as error:
            say(f"loopwright: error: {error}", sys.stderr)
            return 1 if asked is None and not measured else 2
        except LoopwrightError as error:
            say(f"loopwright: error: {error}", sys.stderr)
            return 1
        except KeyboardInterrupt:
            say("loopwright: interrupted; nothing is written.", sys.stderr)
            return 130
        say(f"{diagram.name}: {len(report.numbers())} numbers in {time.perf_counter() - began:.1f} s", sys.stderr)
        for section in report.sections:
            if section.key == KEY and not section.tables:
                say(f"loopwright: the worst case is missing: {section.text[0]}", sys.stderr)
        try:
            files = write_report(report, out, pdf=arguments.pdf, json=arguments.json, paper=arguments.paper)
        except OSError as error:
            found = describe_disk_error(error, out, "Name another file: --out.")
            say(f"loopwright: error: the report can't be written: {found}", sys.stderr)
            return 1
        except KeyboardInterrupt:
            say("loopwright: interrupted; the report is not written.", sys.stderr)
            return 130
    say(f"Written: {'  '.join(map(str, files))}")
    if report.review is not None:
        say(verdict_text(report.review))
        if arguments.at != TRIM and any(_asks_for_rest(result) for result in report.review.of(Verdict.UNDECIDED)):
            say("  Here, diagram.trim(…) is --at trim; --at SECONDS is a point that a run reaches.")
    return EXIT_STATUS[report.review.verdict] if arguments.check and report.review is not None else 0


def _read_worst_case(given: str | None, file: TomlFile | None) -> WorstCaseTask | None:
    """Return the worst case that the file of the option asks for, or that of the requirements."""
    from ..studies import WorstCaseTask

    own = _read_study(given, file, KEY, "--worst-case")
    return None if own is None else WorstCaseTask.read(own)


def _read_contacts(given: str | None, file: TomlFile | None) -> ContactTask | None:
    """Return the contacts that the file of the option asks for, or those of the requirements."""
    from ..studies import ContactTask

    own = _read_study(given, file, CONTACT, "--contact")
    return None if own is None else ContactTask.read(own)


def _read_study(given: str | None, file: TomlFile | None, table: str, option: str) -> TomlFile | None:
    """Return the file with a study's table: that of an option, or that of the requirements; None without it."""
    mine = file is not None and bool(file.table(table))
    if given is None:
        return file if mine else None
    own = TomlFile.read(given, option)
    if file is not None and own.path == file.path:
        return own
    if mine:
        raise own.error(f"the file of the requirements has {SAID[table]}, too; expected one. Leave one out.", table)
    for key in own.content:
        if key not in STUDIES:
            raise own.error(
                f"found it next to [{table}], where requirements are not read. Name the file by --requirements, which "
                "takes its table along.",
                key,
            )
    return own


def _read_measured(given: Sequence[str]) -> dict[str, Any]:
    """Return the data of measured loops by their wires."""
    from ..frequency import measured_margins, read_frequency_data

    found: dict[str, Any] = {}
    for wire, file in parse_pairs(given, "--measured", "WIRE=FILE.csv", "u=u.csv").items():
        found[wire] = read_frequency_data(Path(file).expanduser())
        try:
            measured_margins(found[wire])
        except OptionError as error:
            raise OptionError(error.message, block=file, port=error.port) from None
    return found


def _parse_at(text: str) -> str | float:
    """Return the operating point that was given as a text: `TRIM`, or a time in s."""
    if text == TRIM:
        return text
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value >= 0.0):
        raise argparse.ArgumentTypeError(f"found {text!r}; expected trim, or a time in s that is not negative")
    return value


def _asks_for_rest(result: RequirementResult) -> bool:
    """Return whether a requirement is open as its operating point moves."""
    return result.reason is Reason.MOVING or "diagram.trim(" in explain(result)


def verdict_text(reviewed: Review) -> str:
    """Return the verdict as lines of text: all requirements that are not met, by the paths of their numbers."""
    from ..report import quantity

    lines = [f"Requirements: {reviewed.verdict}.", *(f"  {motion}" for motion in reviewed.free)]
    for result in (*reviewed.of(Verdict.FAILED), *reviewed.of(Verdict.UNDECIDED)):
        parts = (result.loop or result.place, result.variant, result.quantity)
        place = result.path or ".".join(part for part in parts if part)
        found = "" if result.number is None else f" found {quantity(result.number).replace(NARROW, ' ')},"
        why = explain(result)
        reason = f" ({why})" if why else ""
        lines.append(f"  {result.verdict}: {place}:{found} required {result.required}{reason}")
    return "\n".join(lines)


def _analyse(
    diagram: Diagram,
    experiment: Experiment | None,
    arguments: argparse.Namespace,
    asked: Requirements | None,
    about: Mapping[str, str],
    progress: Callable[[str], None],
    measured: Mapping[str, Any],
    searched: WorstCaseTask | None,
    touched: ContactTask | None,
) -> Report:
    from ..report import analyse, with_drawing

    made = analyse(
        diagram,
        at=diagram.trim() if arguments.at == TRIM else arguments.at,
        experiment=experiment,
        stairs=arguments.stairs,
        requirements=asked,
        about=about,
        decibels=arguments.db,
        hertz=arguments.hz,
        progress=progress,
        measured=measured,
        worst_case=searched,
        contacts=touched,
        summary=arguments.summary,
        appendix=not arguments.no_appendix,
        _written=True,
    )
    return with_drawing(made, diagram.wired)


REPORT = Command(
    name="report",
    help="analyse a diagram and write a design report",
    description="Analyse a diagram for design: operating points, poles, margins of its loops, admittance and\n"
    "coupled stability, each number confirmed by an independent computation; and write it as one HTML page.\n\n"
    "DIAGRAM is an experiment of the paper (A, B, C or D; B without one: Fig. 3 with both admittances)\n"
    "or FILE.py:NAME, a diagram of yours, or a function without arguments that returns one.",
    examples=(
        "report loop.py:loop --out loop.html --pdf",
        "report loop.py:loop --requirements loop.toml --check",
        "report loop.py:loop --requirements loop.toml --check --at trim",
        "report C --option delay=1",
    ),
    notes="options of the experiments: as in loopwright run --help",
    exit_status={
        0: "done; with --check: all requirements are met",
        1: "the analysis failed, or a plant could not be built; nothing is written",
        2: "wrong usage; nothing was analysed",
        3: "with --check: a requirement fails; the files are written",
        4: "with --check: a requirement is not decided, and none fails; the files are written",
        130: "interrupted (Ctrl-C); nothing is written",
    },
    arguments=(
        argument("diagram", nargs="?", metavar="DIAGRAM", help="A, B, C, D, or FILE.py:NAME"),
        argument(
            "--at",
            type=_parse_at,
            metavar="trim|SECONDS",
            help="the operating point: trim for the one at rest that diagram.trim() finds, or the time in s to which "
            "the diagram is run (default: the start)",
        ),
        argument("--out", metavar="FILE.html", help="the page (default: fig3.html, or the diagram's name)"),
        flag("--pdf", "the same as PDF next to it (pip install 'loopwright[pdf]')"),
        flag("--json", "all numbers as JSON next to it"),
        argument(
            "--requirements", metavar="FILE.toml", help="requirements on loops and responses; see docs/howto/reports.md"
        ),
        repeated(
            "--measured",
            "WIRE=FILE.csv",
            "a loop that was measured at a wire: its margins are next to the model's, requirements hold for them, "
            "too; repeat it for several",
        ),
        argument(
            "--worst-case",
            metavar="FILE.toml",
            help="find a worst case over ranges of parameters, as the file's table [worst_case] says, which the file "
            "of the requirements may have, too; see docs/howto/worst_case.md",
        ),
        argument(
            "--contact",
            metavar="FILE.toml",
            help="contacts of environments with the plant, as the file's tables [contact.NAME] say, which the file of "
            "the requirements may have, too; see docs/howto/contact.md",
        ),
        flag("--check", "say by the exit status whether they are met"),
        *(argument(f"--{name}", metavar="TEXT", help=f"the {name} in the report's heading") for name in ABOUT),
        flag("--summary", "write the summary alone: two pages"),
        flag("--no-appendix", "leave out the appendix: all numbers, definitions"),
        flag("--db", "draw magnitudes in dB"),
        flag("--hz", "draw frequency responses over Hz in place of rad/s"),
        argument("--paper", choices=["A4", "letter"], default="A4", help="paper of the PDF (default: A4)"),
        PLANT,
        argument(
            "--stairs",
            choices=["gain", "zero"],
            help="take all stairs as their mean slope, or by their slope of zero (default: those of quantizers and "
            "encoders as their mean slope)",
        ),
        experiment_option("an option of the experiment, such as delay=1"),
    ),
    carry_out=_report,
)
