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
from typing import NoReturn

from ...blocks.core import LoopwrightError, OptionError, near
from ...blocks.names_of_other_tools import DURATION, STEP
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
from .validate import VALIDATE

COMMANDS = {
    command.name: command for command in (RUN, DRAW, SWEEP, REPORT, PAGE, C, BUILD, INSPECT, VALIDATE, DOCTOR, SSP)
}
"""All commands by their names, in the order of the help."""
_OPTION_WORDS = {
    **dict.fromkeys(DURATION, "--duration"),
    **dict.fromkeys(STEP, "--step"),
    **dict.fromkeys(("param", "parameter", "parameters", "start_values"), "--set"),
    **dict.fromkeys(("output", "o", "output_file", "outdir", "folder"), "--out"),
}
_COMMAND_WORDS = {
    **dict.fromkeys(("simulate", "sim", "start", "plot"), "run"),
    **dict.fromkeys(("export", "compile"), "build"),
    **dict.fromkeys(("info", "dump", "show"), "inspect"),
    **dict.fromkeys(("analyse", "analyze", "check"), "report"),
    **dict.fromkeys(("html", "web"), "page"),
    "codegen": "c",
}
"""Words of other tools for options, and for commands."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line with arguments, those of the process without them, and return the exit status."""
    parser = make_parser()
    parsers = _parsers(parser)
    try:
        check_command(parser, sys.argv[1:] if argv is None else argv, [*COMMANDS])
        arguments, unknown = parser.parse_known_args(argv)
        if unknown:
            _explain_unknown(parsers.get(arguments.command, parser), unknown)
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


def check_command(parser: argparse.ArgumentParser, given: Sequence[str], known: Sequence[str]) -> None:
    """Print the usage, and the command that may be meant, where there is none of that name; then exit."""
    name = next(iter(given), "-")
    if not name.startswith("-") and name not in known:
        offer = f"Did you mean {_COMMAND_WORDS[name]!r}?" if name in _COMMAND_WORDS else near(name, known)
        parser.error(f"there is no command {name!r}. {offer}")


def _explain_unknown(command: argparse.ArgumentParser, unknown: Sequence[str]) -> NoReturn:
    """Print the usage of a command and, for each option that it doesn't have, the one that may be meant; then exit."""
    known = [text for action in command._actions for text in action.option_strings if text.startswith("--")]
    texts = []
    for given in unknown:
        name = given.partition("=")[0]
        meant = _OPTION_WORDS.get(name.lstrip("-").replace("-", "_"), "")
        if name.startswith("-"):
            offer = f"Did you mean {meant!r}?" if meant in known else near(name, known)
            texts.append(f"there is no option {name}. {offer}")
    command.error(" ".join(texts) or f"unrecognized arguments: {' '.join(unknown)}")
