"""Tables as a page shows them: units in their headings, numbers with links, their confirmations by letters below."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from ....blocks.core import print_unit
from ...frequency import MARK, Number, method_of
from .document import Judged, Table
from .printed_values import cell, is_numeric, mark, quantity, reason, tolerance_text, value_text

LONG, LONG_DETAILS = 14, 8
"""Rows above which a table, or one in the appendix, may go over to the next page."""
WIDE = 6
"""Columns above which a table is set small."""
NO_VALUE, NOT_CONFIRMED = "no value", "not confirmed"


@dataclass(frozen=True)
class Heading:
    """The head of a column, with the unit that all its numbers share."""

    text: str
    unit: str
    right: bool


@dataclass(frozen=True)
class CellView:
    """A cell; ``kind`` is "right" for numbers, "again" where it repeats the cell above.

    Of a number ``about`` has the path, the tolerance and the confirmation; ``anchor`` is where it is in the
    appendix, empty where it doesn't.
    """

    text: str
    kind: str
    is_head: bool
    is_number: bool = False
    anchor: str = ""
    about: str = ""
    letter: str = ""


@dataclass(frozen=True)
class NoteView:
    """A line below a table: why verdicts are open, or how numbers were confirmed, and its letter if it has one."""

    letter: str
    text: str


@dataclass(frozen=True)
class TableView:
    """A table with its number."""

    number: int
    title: str
    headings: tuple[Heading, ...]
    rows: tuple[tuple[CellView, ...], ...]
    reasons: tuple[NoteView, ...]
    """Reasons of verdicts, each a line below the table."""
    note: str
    confirmations: tuple[NoteView, ...]
    is_long: bool
    """Whether it may go over to the next page."""

    @property
    def is_wide(self) -> bool:
        """Whether it is set small."""
        return len(self.headings) > WIDE


class Numbered:
    """Tables of a page in the making, numbered from 1; where ``linked``, the page has the appendix they lead to."""

    def __init__(self, numbers: Mapping[str, Number], *, linked: bool = True):
        self.count, self.linked = 0, linked
        self.terms: dict[str, None] = {}
        """Terms that numbers without a path lead to."""
        self.paths: dict[int, str] = {}
        self.equal: dict[Number, str] = {}
        for path, number in numbers.items():
            self.paths.setdefault(id(number), path)
            self.equal.setdefault(number, path)

    def view(self, table: Table) -> TableView:
        """Return the next table."""
        self.count += 1
        table = _without_empty_columns(table)
        columns = range(len(table.columns))
        units = [_common_unit(table, i) for i in columns]
        right = [is_numeric([row[i] for row in table.rows if i < len(row)]) for i in columns]
        heads = zip(table.columns, units, right, strict=True)
        headings = [_heading(str(text), unit, flush) for text, unit, flush in heads]
        shown = (v for row in table.rows for v in row if isinstance(v, Number))
        reasons = _grouped(v for v in shown if not (table.brief and _is_confirmed(v)))
        verdicts = dict.fromkeys(v.reason for row in table.rows for v in row if isinstance(v, Judged) and v.reason)
        lettered = [*verdicts, *(reasons if verdicts or len(reasons) > 1 else ())]
        letters = {why: _letter(i) for i, why in enumerate(lettered)}
        rows = []
        for above, row in zip([(), *table.rows], table.rows, strict=False):
            cells = []
            for i, value in enumerate(row):
                again = (
                    not right[i]
                    and not isinstance(value, Judged)
                    and i < len(columns) - 1
                    and above[: i + 1] == row[: i + 1]
                )
                kind = "again" if again else "right" if right[i] else ""
                kind = value.verdict.name.lower() if isinstance(value, Judged) else kind
                unit = units[i] is None
                term = table.terms.get(table.columns[i], "")
                cells.append(self._cell(value, kind, letters, table.digits, term, first=i == 0, with_unit=unit))
            rows.append(tuple(cells))
        said = tuple(NoteView(letters.get(method, ""), _said(*why)) for method, why in reasons.items())
        said += tuple(NoteView(MARK, text) for text in _left_out(table))
        why = tuple(NoteView(letters[reason], _sentence(reason)) for reason in verdicts)
        is_long = len(rows) > (LONG_DETAILS if table.details else LONG)
        return TableView(self.count, table.title, tuple(headings), tuple(rows), why, table.note, said, is_long)

    def _cell(
        self, value: Any, kind: str, letters: Mapping[str, str], digits: int, term: str, *, first: bool, with_unit: bool
    ) -> CellView:
        if isinstance(value, Judged):
            return CellView(value.short, kind, first, letter=letters.get(value.reason, ""))
        if not isinstance(value, Number):
            return CellView(cell(value), kind, first)
        path = self.paths.get(id(value)) or ("" if term else self.equal.get(value))
        whole = with_unit or value.is_gain  # a factor has no unit, and its decibels next to it
        text = quantity(value, digits) if whole else value_text(value, digits) + mark(value)
        why = reason(value) if value.given or not value.confirmed_by else f"confirmed by {reason(value)}"
        about = f"{path + ': ' if path else ''}{tolerance_text(value)}; {why}"
        letter = letters.get(_method(value), "")
        if term and not path:
            self.terms[term] = None
        place = "" if not self.linked else anchor("n", path) if path else anchor("d", term) if term else ""
        return CellView(text, kind, False, True, place, about, letter)


def _without_empty_columns(table: Table) -> Table:
    """Return a table without columns that have no entry; the first one stays."""
    kept = [0] + [
        i for i in range(1, len(table.columns)) if any(row[i] not in (None, "") for row in table.rows if i < len(row))
    ]
    if len(kept) == len(table.columns) or not table.rows:
        return table
    rows = tuple(tuple(row[i] for i in kept if i < len(row)) for row in table.rows)
    return replace(table, columns=tuple(table.columns[i] for i in kept), rows=rows)


def anchor(kind: str, key: str) -> str:
    """Return an id: a letter for what it is, then the key, in characters that need no quoting in a link."""
    return f"{kind}-" + re.sub(r"[^A-Za-z0-9._-]", lambda m: f"_{ord(m[0]):x}_", key)


def _method(number: Number) -> str:
    """Return how a number was confirmed, or why there is none, without what only its single case has."""
    return _whole(number, method_of(number.confirmed_by))


def _is_confirmed(number: Number) -> bool:
    return not math.isnan(number.value) and (number.given or bool(number.confirmed_by))


def _grouped(numbers: Iterable[Number]) -> dict[str, tuple[Number, str]]:
    """Return each method of confirmation once: in full where all its numbers have one text, else the method."""
    found: dict[str, tuple[Number, str]] = {}
    for number in numbers:
        method, text = _method(number), _whole(number, number.confirmed_by)
        found[method] = (number, text if found.get(method, (number, text))[1] == text else method)
    return found


def _whole(number: Number, why: str) -> str:
    """Return how a number was confirmed; why there is none; or that it is given, or not confirmed."""
    if math.isnan(number.value):
        return f"{NO_VALUE}: {why}" if why else NO_VALUE
    return str(why) or ("given" if number.given else NOT_CONFIRMED)


def _said(number: Number, why: str) -> str:
    """Return a sentence on how a number was confirmed."""
    plainly = number.given or math.isnan(number.value) or why == NOT_CONFIRMED
    return _sentence(why if plainly else f"confirmed by {why}")


def _sentence(text: str) -> str:
    text = text[0].upper() + text[1:]
    return text if text.endswith((".", "?")) else f"{text}."


def _left_out(table: Table) -> dict[str, None]:
    """Return the texts of the findings that numbers of a table carry, each once."""
    numbers = (value for row in table.rows for value in row if isinstance(value, Number))
    return dict.fromkeys(f"Limit of the linear model: {finding}." for n in numbers for finding in n.findings)


def _common_unit(table: Table, column: int) -> str | None:
    """Return the unit of all numbers in a column; None where they differ."""
    units = {row[column].unit for row in table.rows if column < len(row) and isinstance(row[column], Number)}
    if not units:
        return "1"
    return units.pop() if len(units) == 1 else None


def _heading(text: str, unit: str | None, right: bool) -> Heading:
    """Return a head with the unit that it names itself in brackets, or else that of its numbers."""
    named = re.fullmatch(r"(.*\S)\s\[([^\]]+)\]", text)
    if named is not None:
        return Heading(named[1], named[2], right)
    return Heading(text, "" if unit is None else print_unit(unit), right)


def _letter(i: int) -> str:
    return chr(97 + i) if i < 26 else _letter(i // 26 - 1) + chr(97 + i % 26)
