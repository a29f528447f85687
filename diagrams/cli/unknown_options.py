"""Commands that there are not, and options that a command doesn't have: the one that may be meant."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import NoReturn

from ...blocks.core import near
from ...blocks.names_of_other_tools import DURATION, STEP

_MEANT = {
    **dict.fromkeys(DURATION, "--duration"),
    **dict.fromkeys(STEP, "--step"),
    **dict.fromkeys(("param", "parameter", "parameters", "start_values"), "--set"),
    **dict.fromkeys(("output", "o", "output_file", "outdir", "folder"), "--out"),
}
_COMMANDS = {
    **dict.fromkeys(("simulate", "sim", "start", "plot"), "run"),
    **dict.fromkeys(("export", "compile"), "build"),
    **dict.fromkeys(("info", "dump", "show"), "inspect"),
    **dict.fromkeys(("analyse", "analyze", "check"), "report"),
    **dict.fromkeys(("html", "web"), "page"),
    "codegen": "c",
}
"""Words of other tools for commands."""


def check_command(parser: argparse.ArgumentParser, given: Sequence[str], known: Sequence[str]) -> None:
    """Print the usage, and the command that may be meant, where there is none of that name; then exit."""
    name = next(iter(given), "-")
    if not name.startswith("-") and name not in known:
        offer = f"Did you mean {_COMMANDS[name]!r}?" if name in _COMMANDS else near(name, known)
        parser.error(f"there is no command {name!r}. {offer}")


def explain_unknown(command: argparse.ArgumentParser, unknown: Sequence[str]) -> NoReturn:
    """Print the usage of a command and, for each option that it doesn't have, the one that may be meant; then exit."""
    known = [text for action in command._actions for text in action.option_strings if text.startswith("--")]
    texts = []
    for given in unknown:
        name = given.partition("=")[0]
        meant = _MEANT.get(name.lstrip("-").replace("-", "_"), "")
        if name.startswith("-"):
            offer = f"Did you mean {meant!r}?" if meant in known else near(name, known)
            texts.append(f"there is no option {name}. {offer}")
    command.error(" ".join(texts) or f"unrecognized arguments: {' '.join(unknown)}")
