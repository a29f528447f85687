"""TOML files of a design review: requirements and tables of studies. Errors name the file and the line."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from ...blocks.core import LoopwrightError, OptionError, describe_disk_error, near
from .requirements import Requirements

_HEADER = re.compile(r"""\s*\[\[?\s*(?P<key>(?:"[^"]*"|'[^']*'|[^\]#])+?)\s*\]""")
_KEY = re.compile(r"""\s*(?P<key>(?:"[^"]*"|'[^']*'|[\w.\s-])+?)\s*=""")
_PART = re.compile(r"""\s*(?:"([^"]*)"|'([^']*)'|([\w-]+))\s*\.?""")

STUDIES = ("worst_case", "contact")
"""Tables that belong to studies of the report, and not to its requirements."""
REQUIRED = "requirements"
"""Table of a study with requirements on it."""


@dataclass(frozen=True)
class TomlFile:
    """A TOML file that was read, with the lines of its entries."""

    path: Path
    content: Mapping[str, Any]
    text: str = field(repr=False)

    @classmethod
    def read(cls, path: str | os.PathLike[str], port: str) -> Self:
        """Return a file's content."""
        file = Path(path).expanduser()
        try:
            text = file.read_text(encoding="utf-8-sig")  # some editors put a mark of the byte order first
            return cls(file, tomllib.loads(text), text)
        except OSError as error:
            found = describe_disk_error(error, file, "Name another file.")
            raise OptionError(f"{str(path)!r} can't be read: {found}", port=port) from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise OptionError(f"{str(path)!r} is not TOML: {error}. Mend that line.", port=port) from error

    def error(self, message: str, key: str = "") -> OptionError:
        """Return an error about an entry, by its dotted path: it begins with the file, the line and the entry."""
        line = self.find_line(key) if key else 0
        place = f"{self.path}, line {line}" if line else str(self.path)
        return OptionError(f"{place}: {key}: {message}" if key else f"{place}: {message}")

    def error_at(self, error: LoopwrightError, key: str = "") -> OptionError:
        """Return an error that was raised about an entry as one about this file."""
        return self.error(error.message, ".".join(part for part in (key, error.port) if part))

    def table(self, name: str) -> Mapping[str, Any]:
        """Return a table, empty where the file has none."""
        found: Any = self.content
        for part in name.split("."):
            found = found.get(part, {}) if isinstance(found, Mapping) else found
        if not isinstance(found, Mapping):
            raise self.error(f"found {found!r}; expected a table. Write [{name}], and its entries below.", name)
        return found

    def check_keys(self, table: str, known: tuple[str, ...]) -> None:
        """Refuse entries of a table that it does not have."""
        for key in self.table(table):
            if key not in known:
                raise self.error(f"[{table}] has no {key!r}. {near(key, known)}", f"{table}.{key}")

    def find_line(self, path: str) -> int:
        """Return the line, from 1, of the entry with a dotted path, or of the nearest one above it; 0 without any."""
        found, best, table = 0, "", ""
        for i, line in enumerate(self.text.splitlines(), 1):
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


def read_requirements(path: str | os.PathLike[str] | TomlFile) -> Requirements:
    """Return the requirements that a TOML file has; its names are those of `Requirements`."""
    file = path if isinstance(path, TomlFile) else TomlFile.read(path, "requirements")
    given = {key: value for key, value in file.content.items() if key not in STUDIES}
    try:
        found = Requirements(**given)
    except OptionError as error:
        raise file.error_at(error) from None
    found.place = file.error_at
    contacts = _requires_contacts(file.content.get("contact"))
    if (
        found.is_empty
        and not contacts
        and not (found.loops or found.numbers or found.steps)
        and not given.get("stable")
    ):
        raise OptionError(
            f"{str(file.path)!r} requires nothing; expected a limit. Write one, such as phase_margin_deg = 45, or "
            "stable = true.",
            port="requirements",
        )
    return found


def _requires_contacts(tables: Any) -> bool:
    """Return whether tables of contacts have requirements."""
    if not isinstance(tables, Mapping):
        return False
    return REQUIRED in tables or any(isinstance(one, Mapping) and REQUIRED in one for one in tables.values())


def _joined(key: str) -> str:
    """Return a key of TOML, bare or quoted, as a dotted path."""
    return ".".join("".join(parts) for parts in _PART.findall(key))
