"""An object as a table: declared once as a `Sheet`, shown as plain text by ``print`` and as HTML by a notebook.

A class that inherits `ShownAsTable` declares its sheet in ``_sheet``, and its one-line text in ``__repr__``. Neither
computes anything that takes long, nor reads a file. The HTML inherits the colors of its page.
"""

from __future__ import annotations

import html
import math
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import wraps
from typing import Any

import numpy as np

MOST_ROWS = 30
"""Rows of a table that are shown; the others are counted."""
LONGEST, LONGEST_FACT = 100, 400
"""Characters of a cell, and of a fact, that are shown."""
DIGITS = 6
"""Significant digits of a number."""

_RIGHT = "shown-number"
"""Class of a cell that is set flush right."""
_STYLE = """<style>
div.shown-table { overflow-x: auto; max-width: 100%; color: inherit; }
div.shown-table.shown-table table { border-collapse: collapse; margin: 0.4em 0; border: none; color: inherit; }
div.shown-table.shown-table caption { text-align: left; font-style: italic; color: inherit; padding: 0.2em 0; }
div.shown-table.shown-table :is(th, td) { padding: 0.15em 1em 0.15em 0; border: none; }
div.shown-table.shown-table :is(th, td) { text-align: left; vertical-align: top; }
div.shown-table.shown-table thead th { border-bottom: 1px solid rgba(128, 128, 128, 0.6); white-space: nowrap; }
div.shown-table.shown-table tbody th { font-weight: 400; opacity: 0.75; white-space: nowrap; }
div.shown-table.shown-table .shown-number { text-align: right; white-space: nowrap; }
</style>"""
"""Its rules concern these tables alone, and set no color of text or ground: those are the page's. Two classes in a
selector go before the rules of JupyterLab, which sets text flush right."""


@dataclass(frozen=True)
class Grid:
    """A table: a title, column headings, rows of texts or numbers, and a note below it."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    note: str = ""
    total: int = field(default=0, kw_only=True)
    """Number of rows where ``rows`` holds the first of them only."""


@dataclass(frozen=True)
class Sheet:
    """An object as it is shown: a headline, facts by name, tables, and notes below them."""

    head: str
    facts: tuple[tuple[str, Any], ...] = ()
    """Facts that are None or an empty text are left out."""
    grids: tuple[Grid, ...] = ()
    """Tables without rows are left out."""
    notes: tuple[str, ...] = ()

    def as_text(self) -> str:
        """Return it as plain text."""
        parts = [printable(self.head)] if self.head else []
        facts = [(printable(name), value) for name, value in self._facts()]
        width = max((len(name) for name, _ in facts), default=0)
        parts += [f"  {name:{width}s}  {value}" for name, value in facts]
        for grid in self._grids():
            parts += ["", *_grid_lines(grid)] if parts else _grid_lines(grid)
        parts += ["", *map(printable, self.notes)] if self.notes else []
        return "\n".join(parts)

    def as_html(self) -> str:
        """Return it as an element of HTML, with all its texts escaped."""
        parts = [f"<div><b>{_escape(self.head)}</b></div>"] if self.head else []
        if facts := self._facts():
            parts.append(_facts_element(facts))
        parts += map(_element, self._grids())
        parts += [f"<div>{_escape(note)}</div>" for note in self.notes]
        return f'{_STYLE}<div class="shown-table">{"".join(parts)}</div>'

    def _facts(self) -> list[tuple[str, str]]:
        return [(name, cell_text(value, LONGEST_FACT)) for name, value in self.facts if not _is_empty(value)]

    def _grids(self) -> list[Grid]:
        return [_without_empty_columns(grid) for grid in self.grids if grid.rows]


class ShownAsTable:
    """An object that shows itself: as a table by ``print`` and in a notebook, in one line by ``repr``.

    Showing never raises: an object that is not complete says so.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        for name in ("__repr__", "__str__", "_repr_html_", "_repr_svg_"):
            if name in vars(cls):
                setattr(cls, name, _safe(vars(cls)[name]))

    def _sheet(self) -> Sheet:
        """Return the object as it is shown."""
        return Sheet(repr(self))

    def __str__(self) -> str:
        try:
            return self._sheet().as_text()
        except Exception:  # whatever the object lacks
            return repr(self)

    def _repr_html_(self) -> str | None:
        """Return the table as HTML; None, by which a notebook shows the short text, where the object lacks parts."""
        try:
            return self._sheet().as_html()
        except Exception:
            return None


def _safe(show: Callable[[Any], str]) -> Callable[[Any], str | None]:
    """Return a method that shows an object and doesn't raise; None has a notebook take the short text."""

    @wraps(show)
    def shown(self: Any) -> str | None:
        try:
            return show(self)
        except Exception as error:  # whatever the object lacks
            short = f"<{type(self).__name__} that can't be shown: {type(error).__name__}>"
            return short if show.__name__ in ("__repr__", "__str__") else None

    return shown


def cell_text(value: Any, longest: int = LONGEST) -> str:
    """Return a value as the text of a cell, in one line, cut where it is long: ``0.333333``, ``yes``, ``1, a``."""
    if value is None:
        return ""
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        return f"{float(value) + 0.0:.{DIGITS}g}"
    if isinstance(value, np.ndarray):
        value = value.tolist() if value.size <= LONGEST else f"array of shape {value.shape}"
    if isinstance(value, list | tuple):
        value = ", ".join(cell_text(one) for one in value[:LONGEST])
    text = printable(repr(value) if isinstance(value, ShownAsTable) else str(value))
    return text if len(text) <= longest else text[: longest - 1] + "…"


def printable(text: str) -> str:
    """Return a text in one line, with characters that control a terminal or the direction of writing spelt out."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or unicodedata.category(c) == "Zs" else ascii(c)[1:-1] for c in text)


def _is_number(value: Any) -> bool:
    if isinstance(value, bool | np.bool_ | str | np.ndarray):
        return False
    return isinstance(value, int | float | np.number) or hasattr(value, "__float__")


def _is_empty(value: Any) -> bool:
    return value is None or (isinstance(value, str | tuple | list) and len(value) == 0)


def _alignments(grid: Grid) -> list[str]:
    """Return the side to which each column is set: numbers flush right."""
    return [_RIGHT if _is_number_column(column) else "" for column in _columns(grid)]


def _is_number_column(values: Sequence[Any]) -> bool:
    given = [value for value in values if not _is_empty(value)]
    return bool(given) and all(map(_is_number, given))


def _columns(grid: Grid) -> Iterator[list[Any]]:
    width = max([len(grid.columns), *(len(row) for row in grid.rows)])
    return ([row[i] for row in grid.rows if i < len(row)] for i in range(width))


def _without_empty_columns(grid: Grid) -> Grid:
    """Return a table without the columns that have no entry."""
    kept = [i for i, column in enumerate(_columns(grid)) if not all(map(_is_empty, column))]
    rows = tuple(tuple(row[i] for i in kept if i < len(row)) for row in grid.rows)
    columns = tuple(grid.columns[i] for i in kept if i < len(grid.columns))
    return Grid(grid.title, columns, rows, grid.note, total=grid.total)


def _shown_rows(grid: Grid) -> tuple[list[list[str]], str]:
    """Return the texts of the rows that are shown, and the line on the others."""
    rows = [[cell_text(value) for value in row] for row in grid.rows[:MOST_ROWS]]
    more = max(len(grid.rows), grid.total) - len(rows)
    return rows, f"and {more} more" if more > 0 else ""


def _grid_lines(grid: Grid) -> list[str]:
    rows, more = _shown_rows(grid)
    heads = [list(map(printable, grid.columns))] if any(grid.columns) else []
    sides = _alignments(grid)
    widths = [max(len(row[i]) for row in [*heads, *rows] if i < len(row)) for i in range(len(sides))]

    def line(row: list[str]) -> str:
        cells = zip(row, widths, sides, strict=False)
        return "  ".join(f"{text:{'>' if side == _RIGHT else '<'}{width}s}" for text, width, side in cells).rstrip()

    lines = [grid.title, *map(line, [*heads, *rows]), more, grid.note]
    return [printable(text) for k, text in enumerate(lines) if text or 0 < k < len(lines) - 2]


def _facts_element(facts: Iterable[tuple[str, str]]) -> str:
    rows = (f'<tr><th scope="row">{_escape(name)}</th><td>{html.escape(text)}</td></tr>' for name, text in facts)
    return f"<table><tbody>{''.join(rows)}</tbody></table>"


def _element(grid: Grid) -> str:
    """Return a table as HTML."""
    rows, more = _shown_rows(grid)
    sides = _alignments(grid)
    parts = [f"<caption>{_escape(grid.title)}</caption>"] if grid.title else []
    if any(grid.columns):
        heads = zip(grid.columns, sides, strict=False)
        cells = (f'<th scope="col"{_class(side)}>{_escape(text)}</th>' for text, side in heads)
        parts.append(f"<thead><tr>{''.join(cells)}</tr></thead>")
    lines = (
        "".join(f"<td{_class(side)}>{html.escape(text)}</td>" for text, side in zip(row, sides, strict=False))
        for row in rows
    )
    below = "".join(f"<div>{_escape(text)}</div>" for text in (more, grid.note) if text)
    return f"<table>{''.join(parts)}<tbody>{''.join(f'<tr>{line}</tr>' for line in lines)}</tbody></table>{below}"


def _class(side: str) -> str:
    return f' class="{side}"' if side else ""


def _escape(text: str) -> str:
    return html.escape(printable(text))


def decibels(factor: float) -> str:
    """Return a gain in dB, for a cell next to the factor; empty where it has none, as of 0."""
    return f"{20 * math.log10(factor):.3g} dB" if 0.0 < factor < math.inf else ""
