"""A command of the command line as data: its page of help, its arguments, and the function that carries it out."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Argument:
    """An argument: its names, the keywords of argparse's ``add_argument``, and its heading in the help."""

    names: tuple[str, ...]
    options: Mapping[str, Any]
    heading: str | None = None

    @property
    def destination(self) -> str:
        """The attribute of the parsed arguments that has its value."""
        return str(self.options.get("dest", self.names[0].lstrip("-").replace("-", "_")))


def argument(*names: str, heading: str | None = None, **options: Any) -> Argument:
    """Return an argument; its options are those of argparse."""
    return Argument(names, options, heading)


def flag(name: str, text: str, **options: Any) -> Argument:
    """Return an option without a value."""
    return argument(name, action="store_true", help=text, **options)


def repeated(name: str, metavar: str, text: str, **options: Any) -> Argument:
    """Return an option that may be given several times; its values are a list."""
    return argument(name, metavar=metavar, action="append", default=[], help=text, **options)


def several(name: str, metavar: str, text: str, **options: Any) -> Argument:
    """Return an option that takes one or more values, and may be given several times."""
    return argument(name, nargs="+", metavar=metavar, action="extend", help=text, **options)


@dataclass(frozen=True, kw_only=True)
class Command:
    """A command; its help has the examples, the notes if any, and the exit status, a line each or as one text."""

    name: str
    help: str
    description: str
    examples: tuple[str, ...]
    notes: str = ""
    exit_status: Mapping[int, str] | str
    arguments: tuple[Argument, ...]
    carry_out: Callable[[argparse.Namespace], int]
    usage: str | None = None
    writes_at_the_end: bool = False  # an interrupt leaves nothing written

    def add_to(self, commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
        """Add the command to the commands of a parser."""
        parser = commands.add_parser(
            self.name,
            help=self.help,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            usage=self.usage,
            description=self.description,
            epilog=self._epilog(),
        )
        headings: dict[str, argparse._ArgumentGroup] = {}
        for one in self.arguments:
            place: argparse._ActionsContainer = parser
            if one.heading is not None:
                if one.heading not in headings:
                    headings[one.heading] = parser.add_argument_group(one.heading)
                place = headings[one.heading]
            place.add_argument(*one.names, **one.options)

    def _epilog(self) -> str:
        examples = "\n".join(("examples:", *(f"  loopwright {example}" for example in self.examples)))
        status = f" {self.exit_status}" if isinstance(self.exit_status, str) else ""
        if isinstance(self.exit_status, Mapping):
            status = "".join(f"\n  {code:<3}  {text}" for code, text in self.exit_status.items())
        return "\n\n".join(part for part in (examples, self.notes, f"exit status:{status}") if part)
