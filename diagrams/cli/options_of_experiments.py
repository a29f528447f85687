"""Options of experiments on the command line."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from inspect import signature
from typing import Any

from ...blocks.core import OptionError, near
from ..paper import DEFAULTS, EXPERIMENTS
from .command_arguments import parse_pairs, parse_value
from .text import say


def known_options(letter: str) -> dict[str, Any]:
    """Return the options of an experiment with their defaults."""
    own = {p.name: p.default for p in signature(EXPERIMENTS[letter]).parameters.values() if p.kind is p.KEYWORD_ONLY}
    limits = ("velocity_limit", "acceleration_limit") if letter == "A" else ()  # it has no admittance to limit
    return {name: value for name, value in {**DEFAULTS, **own}.items() if name not in limits}


def option_lines() -> Iterable[str]:
    """Yield a line for each option: its default, and the experiments that have it."""
    for name, value in {name: value for letter in EXPERIMENTS for name, value in known_options(letter).items()}.items():
        if name not in ("plant", "path"):
            owners = [letter for letter in EXPERIMENTS if name in known_options(letter)]
            only = "" if len(owners) == len(EXPERIMENTS) else f"  ({', '.join(owners)} only)"
            yield f"{name}={value}{only}"


def parse_letters(given: Sequence[str]) -> list[str]:
    """Return the letters of experiments: ``A B``, ``A,B`` and ``AB`` alike, all of them without one."""
    pieces = [piece.strip() for text in given for piece in text.split(",")]
    for piece in pieces:
        if (not piece and len(pieces) == 1) or any(letter not in EXPERIMENTS for letter in piece.upper()):
            raise OptionError(f"there is no experiment {piece!r}. Known: {', '.join(EXPERIMENTS)}.")
    return list(dict.fromkeys("".join(pieces).upper())) or list(EXPERIMENTS)


def parse_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the options that were given, by name."""
    options: dict[str, Any] = {}
    for given, value in parse_pairs(arguments.options, "--option", "NAME=VALUE", "delay=1").items():
        name = given.replace("-", "_")
        if name == "path":
            raise OptionError(
                "a path can't be given on the command line; take Python: "
                "loopwright.experiments.path_following(path=…).simulate().",
                port="--option path",
            )
        if name in options:
            raise OptionError("it is given twice; give it once.", port=f"--option {name}")
        options[name] = parse_value(value)
    if arguments.plant is not None:
        if "plant" in options:
            raise OptionError("the plant is given twice; give it once.", port="--plant")
        options["plant"] = arguments.plant
    return options


def parse_renames(arguments: argparse.Namespace) -> dict[str, str]:
    """Return the ports' names that were given to the plant, by the FMU's names."""
    # Names of variables may contain "="; ports of Fig. 3 don't.
    found = parse_pairs(arguments.renames, "--rename", "NAME=PORT", "'s_y=position[1]'", last=True)
    if found and arguments.plant is None:
        raise OptionError("it names ports of another plant; give that plant, too.", port="--rename")
    return found


def share(letters: Sequence[str], options: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Give every experiment the options that it has."""
    for name in options:
        owners = [letter for letter in EXPERIMENTS if name in known_options(letter)]
        without = [letter for letter in letters if letter not in owners]
        if not owners:
            known = {name for letter in EXPERIMENTS for name in known_options(letter)} - {"path"}
            raise OptionError(f"no experiment has such an option. {near(name, known)}", port=f"--option {name}")
        if len(without) == len(letters):
            raise OptionError(
                f"{_join(without)} can't take it; an option of {_join(owners)} only.",
                port=f"--option {name}",
            )
        if without:
            have = "has" if len(owners) == 1 else "have"
            say(f"{', '.join(without)}: without {name}, which only {_join(owners)} {have}.", sys.stderr)
    return {letter: {k: v for k, v in options.items() if k in known_options(letter)} for letter in letters}


def _join(letters: Sequence[str]) -> str:
    """Write a list in words: A; A and B; A, B and C."""
    *first, last = letters
    return f"{', '.join(first)} and {last}" if first else last
