"""Subjects of commands: experiments of the paper by letter, and diagrams in users' files, ``FILE.py:NAME``."""

from __future__ import annotations

import argparse
import contextlib
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

from ...blocks.core import DefinitionError, LoopwrightError, OptionError, near
from ...fmus.models import gantry
from ..diagram import Diagram
from ..paper import EXPERIMENTS, Experiment
from ..ssp import read_ssp
from .options_of_experiments import parse_options, share
from .text import say
from .user_models import line_text, load_user_file

_SSP = re.compile(r"(?P<file>.*?\.(?:ssp|ssd))(?::(?P<variant>.+))?", re.IGNORECASE)


@contextlib.contextmanager
def open_subject(subject: str, arguments: argparse.Namespace) -> Iterator[tuple[Diagram, Experiment | None]]:
    """Yield the diagram, and its experiment where it has one."""
    if is_user_file(subject):
        for name, given in (("--option", arguments.options), ("--plant", arguments.plant)):
            if given:
                raise OptionError("it is for experiments; set it in the file.", port=name)
        with open_user_diagram(subject) as found:
            yield found
        return
    experiment = _make_experiment(subject, arguments)
    yield experiment.diagram, experiment


def is_user_file(subject: str) -> bool:
    """Return whether a subject names a file of a user's, and no experiment."""
    return ".py" in subject or is_ssp(subject)


def is_ssp(subject: str) -> bool:
    """Return whether a subject names an SSP, or a separate description (.ssd)."""
    return _SSP.fullmatch(subject) is not None


def split_ssp(subject: str) -> tuple[str, str | None]:
    """Return the file of an SSP, and the name of the variant behind its colon; None without one."""
    match = _SSP.fullmatch(subject)
    return (subject, None) if match is None else (match["file"], match["variant"])


def proposed(subject: str) -> dict[str, float]:
    """Return what an SSP proposes for a run: ``duration`` and ``step``, as far as it does."""
    if not is_ssp(subject):
        return {}
    about = read_ssp(*split_ssp(subject))
    found = {"duration": about.stop, "step": about.step}
    return {name: value for name, value in found.items() if value is not None and value > 0.0}


@contextlib.contextmanager
def open_user_diagram(subject: str) -> Iterator[tuple[Diagram, Experiment | None]]:
    """Yield the diagram of ``FILE.py:NAME`` or ``FILE.ssp``, and its experiment where it has one."""
    if is_ssp(subject):
        yield Diagram.from_ssp(*split_ssp(subject)), None
        return
    with load_user_file(subject, port="DIAGRAM") as (module, path, name):
        found = find_diagram(vars(module), path, name)
        yield (found.diagram, found) if isinstance(found, Experiment) else (found, None)


def _make_experiment(name: str, arguments: argparse.Namespace) -> Experiment:
    letter = name.upper()
    if letter not in EXPERIMENTS:
        raise OptionError(
            f"found {name!r}; expected one of {', '.join(EXPERIMENTS)}, or FILE.py:NAME, such as loop.py:diagram.",
            port="DIAGRAM",
        )
    options = share([letter], parse_options(arguments))[letter]
    if options.get("plant") is None:
        gantry.build(notify=lambda line: say(line, sys.stderr))
    return EXPERIMENTS[letter](**options)


def find_diagram(names: Mapping[str, object], path: Path, name: str) -> Diagram | Experiment:
    """Return the diagram or experiment that a name means in a user's file."""
    source, file = str(path), path.name
    known = {key: value for key, value in names.items() if isinstance(value, Diagram | Experiment)}
    if not name:
        if len(known) == 1:
            return next(iter(known.values()))
        example = f" Write {file}:{next(iter(known), 'NAME')}."
        raise OptionError(f"expected FILE.py:NAME. Its diagrams: {', '.join(known) or 'none'}.{example}", block=source)
    if name not in names:
        hint = near(name, known) if known else "There is no Diagram in it."
        raise OptionError(f"there is no {name!r} in it. {hint}", block=source)
    found = names[name]
    if callable(found) and not isinstance(found, Diagram | Experiment | type):
        try:
            found = found()
        except LoopwrightError as error:
            raise DefinitionError(f"{name}() fails{line_text(error, path)}: {error}", block=source) from error
        except Exception as error:
            raise DefinitionError(
                f"{name}() fails{line_text(error, path)}: {type(error).__name__}: {error}. Give a diagram, or a "
                "function without arguments that returns one.",
                block=source,
            ) from error
    if not isinstance(found, Diagram | Experiment):
        raise OptionError(
            f"found {type(found).__name__} for {name!r}; expected a Diagram. Its diagrams: "
            f"{', '.join(known) or 'none'}.",
            block=source,
        )
    return found
