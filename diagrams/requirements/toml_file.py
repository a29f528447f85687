"""Requirements from a TOML file."""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path

from ...blocks.core import OptionError
from .requirements import Requirements

_HEADER = re.compile(r"\s*\[\[?\s*(?P<key>[^\]#]+?)\s*\]")
_KEY = re.compile(r"""\s*(?P<key>(?:"[^"]*"|'[^']*'|[\w.\s-])+?)\s*=""")
_PART = re.compile(r"""\s*(?:"([^"]*)"|'([^']*)'|([\w-]+))\s*\.?""")


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
        text = file.read_text(encoding="utf-8")
        given = tomllib.loads(text)
    except OSError as error:
        raise OptionError(
            f"{str(path)!r} can't be read: {error.strerror}. Name another file.", port="requirements"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise OptionError(f"{str(path)!r} is not TOML: {error}. Mend that line.", port="requirements") from error
    try:
        found = Requirements(**given)
    except OptionError as error:
        line = _find_line(text, error.port or "")
        place = f"{path}, line {line}" if line else str(path)
        raise OptionError(
            f"{place}: {error.port}: {error.message}" if error.port else f"{place}: {error.message}"
        ) from None
    if found.is_empty and not (found.loops or found.numbers or found.steps):
        raise OptionError(
            f"{str(path)!r} requires nothing; expected a limit. Write one, such as phase_margin_deg = 45.",
            port="requirements",
        )
    return found


def _find_line(text: str, path: str) -> int:
    """Return the line, from 1, of the entry with a dotted path, or of the nearest one above it; 0 without any."""
    found, best, table = 0, "", ""
    for i, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            here = table = _joined(header["key"])
        elif key := _KEY.match(line):
            here = ".".join(part for part in (table, _joined(key["key"])) if part)
        else:
            continue
        if (path == here or path.startswith(f"{here}.")) and len(here) > len(best):
            found, best = i, here
        elif not found and here.startswith(f"{path}."):
            found = i
    return found


def _joined(key: str) -> str:
    """Return a key of TOML, bare or quoted, as a dotted path."""
    return ".".join("".join(parts) for parts in _PART.findall(key))
