"""Arguments that several commands have, and the values that their texts mean."""

from __future__ import annotations

import argparse
import ast
import math
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

from ...blocks.core import LoopwrightError, OptionError
from ..diagram import Diagram
from .command import Argument, argument, flag, repeated

_WORDS: Mapping[str, bool | None] = MappingProxyType(
    {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False, "none": None, "null": None}
)


# --- values ---------------------------------------------------------------------------------------------------------


def parse_positive(text: str) -> float:
    """Return a positive number that was given as a text."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"found {text!r}; expected a positive number")
    return value


def parse_value(text: str) -> Any:
    """Read a word of `_WORDS`, or a Python or JSON literal; anything else is text."""
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return text


def parse_pairs(given: Iterable[str], option: str, form: str, example: str, *, last: bool = False) -> dict[str, str]:
    """Return the values of an option NAME=VALUE by name; with ``last`` names may contain ``=``, and values may not."""
    found: dict[str, str] = {}
    for text in given:
        name, equals, value = (part.strip() for part in (text.rpartition("=") if last else text.partition("=")))
        if not equals or not name or not value:
            raise OptionError(f"found {text!r}; expected {form}, such as {option} {example}.", port=option)
        if name in found:
            raise OptionError("it is given twice; give it once.", port=f"{option} {name}")
        found[name] = value
    return found


# --- arguments ------------------------------------------------------------------------------------------------------

DIAGRAM = argument("diagram", metavar="DIAGRAM", help="FILE.py:NAME")
DIAGRAM_TEXT = (
    "DIAGRAM is FILE.py:NAME: a diagram in a file of yours, or a function without arguments that returns one;\n"
    "or FILE.ssp, an SSP of any tool.\n"
)
"""What the argument `DIAGRAM` takes, in a description."""


def duration(text: str, **options: Any) -> Argument:
    """Return ``--duration``, the simulated time in s."""
    return argument("--duration", type=parse_positive, metavar="S", help=text, **options)


def step(**options: Any) -> Argument:
    """Return ``--step``, the step between ticks in s."""
    text = "step between ticks, where there is no clock"
    return argument("--step", type=parse_positive, metavar="S", help=text, **options)


def solver(text: str, **options: Any) -> Argument:
    """Return ``--solver``, the name of a solver."""
    return argument("--solver", metavar="NAME", help=text, **options)


def given_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return ``--step`` and ``--solver`` as keywords, as far as they are given."""
    return {name: value for name in ("step", "solver") if (value := getattr(arguments, name)) is not None}


def set_parameters(**options: Any) -> Argument:
    """Return ``--set``, other values of parameters, which `change_diagram` reads."""
    text = "another value of a parameter, such as pid.kp=3; repeat it for several"
    return repeated("--set", "PATH=VALUE", text, dest="changes", **options)


def change_diagram(diagram: Diagram, arguments: argparse.Namespace) -> Diagram:
    """Return a diagram with the parameters that ``--set`` gives."""
    pairs = parse_pairs(arguments.changes, "--set", "PATH=VALUE", "pid.kp=3")
    if not pairs:
        return diagram
    try:
        return diagram.replace({name: parse_value(value) for name, value in pairs.items()})
    except LoopwrightError as error:
        raise OptionError(str(error), port="--set") from error


def as_json(content: str, *, heading: str | None = None) -> Argument:
    """Return ``--json``, which prints a content as JSON in place of the text."""
    return flag("--json", f"print {content} as JSON", heading=heading)


PLANT = argument("--plant", metavar="FILE.fmu", help="another plant in place of the gantry")


def experiment_option(text: str) -> Argument:
    """Return ``--option``, an option of the paper's experiments."""
    return repeated("--option", "NAME=VALUE", f"{text}; repeat it for several", dest="options")
