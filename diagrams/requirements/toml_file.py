"""Requirements from a TOML file."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path

from ...blocks.core import OptionError
from .requirements import Requirements


def read_requirements(path: str | os.PathLike[str]) -> Requirements:
    """Return the requirements that a TOML file has; its names are those of `Requirements`.

    Parameters
    ----------
    path : path
        File such as this one::

            phase_margin_deg = 45
            bandwidth = [50, 200]
            variants = ["sampled_d1"]

            [step]
            overshoot = 0.3

            [loops.u]
            ms = 1.6

    Raises
    ------
    OptionError
        A file that isn't there or isn't TOML; an unknown name; a limit that is none.
    """
    file = Path(path).expanduser()
    try:
        given = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise OptionError(
            f"{str(path)!r} can't be read: {error.strerror}. Name another file.", port="requirements"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise OptionError(f"{str(path)!r} is not TOML: {error}. Mend that line.", port="requirements") from error
    try:
        found = Requirements(**given)
    except OptionError as error:
        raise OptionError(error.message, block=str(path), port=error.port) from None
    if found.is_empty and not (found.loops or found.numbers or found.steps):
        raise OptionError(
            f"{str(path)!r} requires nothing; expected a limit. Write one, such as phase_margin_deg = 45.",
            port="requirements",
        )
    return found
