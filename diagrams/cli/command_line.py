"""The command line, ``loopwright``.

Exit status: 0 done, 1 a run or a build failed (its record is written) or an FMU has problems, 2 wrong usage,
130 interrupted.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version

from ...blocks.core import LoopwrightError, OptionError
from .build import BUILD
from .c_code import C
from .doctor import DOCTOR
from .draw import DRAW
from .inspection import INSPECT
from .page import PAGE
from .report import REPORT
from .run import RUN
from .ssp import SSP
from .sweep import SWEEP
from .text import say
from .unknown_options import check_command, explain_unknown
from .validate import VALIDATE

COMMANDS = {
    command.name: command for command in (RUN, DRAW, SWEEP, REPORT, PAGE, C, BUILD, INSPECT, VALIDATE, DOCTOR, SSP)
}
"""All commands by their names, in the order of the help."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line with arguments, those of the process without them, and return the exit status."""
    parser = make_parser()
    parsers = _parsers(parser)
    try:
        check_command(parser, sys.argv[1:] if argv is None else argv, [*COMMANDS])
        arguments, unknown = parser.parse_known_args(argv)
        if unknown:
            explain_unknown(parsers.get(arguments.command, parser), unknown)
    except SystemExit as stop:
        return int(stop.code or 0)
    if arguments.command is None:
        parser.print_help(sys.stderr)
        return 2
    command = COMMANDS[arguments.command]
    try:
        return command.carry_out(arguments)
    except OptionError as error:
        say(f"loopwright: error: {error}", sys.stderr)
        return 2
    except LoopwrightError as error:
        say(f"loopwright: error: {error}", sys.stderr)
        return 1
    except KeyboardInterrupt:
        say(f"loopwright: interrupted{'; nothing is written' if command.writes_at_the_end else ''}.", sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of a pipe, such as head, has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python complains when it ends
        return 1


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="loopwright", description="Block diagrams and co-simulation for control engineers."
    )
    parser.add_argument("--version", action="version", version=f"loopwright {_version()}")
    commands = parser.add_subparsers(dest="command", metavar="command")
    for command in COMMANDS.values():
        command.add_to(commands)
    return parser


def _parsers(parser: argparse.ArgumentParser) -> Mapping[str, argparse.ArgumentParser]:
    """Return the parsers of all commands by their names."""
    groups = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    found: Mapping[str, argparse.ArgumentParser] = groups[0].choices
    return found


def _version() -> str:
    try:
        return version("loopwright")
    except PackageNotFoundError:
        return "(not installed)"
