"""A report as one HTML page: styles and figures are in it; it needs no network and no script."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

from ..frequency.number import Number
from .definitions import LOOP, LOOP_TERMS, definition
from .figures import DRAWING, embedded
from .model import Plot, Report, Section, Table
from .style import STYLE
from .values import cell, is_numeric, quantity, symbol, tolerance_text, value_text

_LONG = 30
"""Rows above which a table may go over to the next page."""


NO_VALUE = "no value"

_LONG_WORD = re.compile(r"\b[0-9a-f]{32,}\b|(?<![<&])[\w./\\-]{40,}")
_PIECES = re.compile(r"[^/\\._-]{1,16}[/\\._-]?|[/\\._-]")
"""Words that are too long for a column, such as digests and paths of files, and where they may break."""

_NUMBERS = """\
<section id="numbers" class="level2">
<h2><span class="no">A</span> All numbers</h2>
<p>By the dotted paths under which they stand in the JSON. The tolerance bounds the numerical error of the value, not
what the model leaves out. How a number was confirmed stands below, under the number in brackets.</p>
"""


def to_html(report: Report) -> str:
    """Return the page.

    Every number in a table leads to its line in the appendix: dotted path, tolerance, how it was confirmed, and from
    there to its definition.
    """
    return _Page(report).text()


class _Page:
    """A page in the making."""

    def __init__(self, report: Report):
        self.report = report
        self.numbers = report.numbers()
        self.more: Mapping[str, str] = report.meta.get("definitions") or {}
        self.paths: dict[int, str] = {}
        self.equal: dict[Number, str] = {}
        for path, number in self.numbers.items():
            self.paths.setdefault(id(number), path)
            self.equal.setdefault(number, path)
        self.count = {"table": 0, "figure": 0}
        self.keys: set[str] = set()

    def text(self) -> str:
        """Return it all."""
        report = self.report
        parts = [self._section(s, (str(i),), s.key) for i, s in enumerate(report.sections, 1)]
        contents = self._contents()
        return (
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f"<title>{escape(report.title)}</title>\n<style>\n{STYLE}</style>\n</head>\n<body>\n"
            f'<header><h1>{_marked(report.title)}</h1>\n{self._meta()}</header>\n<nav aria-label="Contents">\n'
            f"<h2>Contents</h2>\n{contents}</nav>\n<main>\n{''.join(parts)}{self._appendix()}</main>\n</body>\n</html>\n"
        )

    def _meta(self) -> str:
        lines = []
        for key, value in self.report.meta.items():
            if key == "definitions" or value in (None, "", {}, ()):
                continue
            if isinstance(value, Mapping):
                pairs = {str(k): cell(v) for k, v in value.items()}
                plainly = all(len(text.split()) == 1 for text in pairs.values())
                said = [v if k == v else f"{k}{' ' if plainly else ': '}{v}" for k, v in pairs.items()]
                value = (", " if plainly else "; ").join(said)
            elif isinstance(value, list | tuple):
                value = ", ".join(map(cell, value))
            name = escape(str(key).replace("_", " "))
            lines.append(f'<tr><th scope="row">{name}</th><td>{_marked(cell(value))}</td></tr>\n')
        return f'<table class="about">\n{"".join(lines)}</table>\n' if lines else ""

    def _contents(self) -> str:
        def entries(sections: Sequence[Section], prefix: str, number: str, depth: int) -> str:
            lines = []
            for i, section in enumerate(sections, 1):
                key = f"{prefix}{section.key}"
                inner = entries(section.sections, f"{key}.", f"{number}{i}.", depth + 1) if depth < 2 else ""
                lines.append(
                    f'<li><a href="#{_anchor("s", key)}"><span class="no">{number}{i}</span> '
                    f"{_marked(section.title)}</a>{inner}</li>\n"
                )
            return f"<ol>\n{''.join(lines)}</ol>\n" if lines else ""

        body = entries(self.report.sections, "", "", 1)
        extra = '<li><a href="#numbers"><span class="no">A</span> All numbers</a></li>\n' if self.numbers else ""
        if self._defined():
            extra += '<li><a href="#definitions"><span class="no">B</span> Definitions</a></li>\n'
        return body.removesuffix("</ol>\n") + extra + "</ol>\n" if body else f"<ol>\n{extra}</ol>\n"

    # --- sections ---------------------------------------------------------------------------------------------------

    def _section(self, section: Section, number: tuple[str, ...], key: str) -> str:
        level = min(len(number) + 1, 4)
        drawings = [plot for plot in section.plots if plot.key.startswith(DRAWING)]
        figures = [plot for plot in section.plots if not plot.key.startswith(DRAWING)]
        head = f'<h{level}><span class="no">{".".join(number)}</span> {_marked(section.title)}</h{level}>\n'
        parts = [*map(self._plot, drawings), *map(self._table, section.tables), *map(self._plot, figures)]
        if parts and not section.text and not parts[0].startswith('<div class="table long'):
            parts[0] = f'<div class="keep">{head}{parts[0]}</div>\n'  # a heading stays with what it is about
        else:
            parts.insert(0, head + _paragraphs(section.text))
        for i, inner in enumerate(section.sections, 1):
            parts.append(self._section(inner, (*number, str(i)), f"{key}.{inner.key}"))
        return f'<section id="{_anchor("s", key)}" class="level{level}">\n{"".join(parts)}</section>\n'

    def _plot(self, plot: Plot) -> str:
        self.count["figure"] += 1
        key = plot.key
        while key in self.keys:
            key += "_"
        self.keys.add(key)
        return (
            f'<figure id="{_anchor("f", key)}">\n{embedded(plot.figure, _anchor("f", key))}'
            f"<figcaption><b>Figure {self.count['figure']}.</b> {_marked(plot.caption)}</figcaption>\n</figure>\n"
        )

    def _table(self, table: Table) -> str:
        self.count["table"] += 1
        columns = len(table.columns)
        units = [_common_unit(table, i) for i in range(columns)]
        right = [is_numeric([row[i] for row in table.rows if i < len(row)]) for i in range(columns)]
        heads = []
        for i, heading in enumerate(table.columns):
            unit = "" if units[i] in (None, "1") or _says(heading, units[i] or "") else symbol(units[i] or "")
            small = f' <span class="unit">({escape(unit)})</span>' if unit else ""
            heads.append(f'<th scope="col"{_right(right[i])}>{_marked(str(heading))}{small}</th>')
        reasons = _grouped(_reason(v) for row in table.rows for v in row if isinstance(v, Number))
        letters = {kind: _letter(i) for i, kind in enumerate(reasons)} if len(reasons) > 1 else {}
        body = []
        for above, row in zip([(), *table.rows], table.rows, strict=False):
            cells = []
            for i, value in enumerate(row):
                tag = 'th scope="row"' if i == 0 and not isinstance(value, Number) else "td"
                if isinstance(value, str) and table.columns[i] == "unit":
                    value = symbol(value)
                text = self._cell(value, letters, with_unit=units[i] is None)
                again = not right[i] and i < columns - 1 and above[: i + 1] == row[: i + 1]
                kind = " class=again" if again else _right(right[i])
                cells.append(f"<{tag}{kind}>{text}</{tag.split()[0]}>")
            body.append(f"<tr>{''.join(cells)}</tr>\n")
        wide = ' class="dense"' if columns > 6 else ""
        long = " long" if len(table.rows) > _LONG else ""
        return (
            f'<div class="table{long}"><table{wide}>\n<caption><b>Table {self.count["table"]}.</b> '
            f"{_marked(table.title)}</caption>\n<thead><tr>{''.join(heads)}</tr></thead>\n<tbody>\n{''.join(body)}"
            f"</tbody>\n</table>{self._notes(table, letters, reasons)}</div>\n"
        )

    def _cell(self, value: Any, letters: Mapping[str, str], *, with_unit: bool) -> str:
        if not isinstance(value, Number):
            return _LONG_WORD.sub(lambda word: "<wbr>".join(_PIECES.findall(word[0])), _marked(cell(value)))
        path = self.paths.get(id(value)) or self.equal.get(value)
        text = escape(quantity(value) if with_unit else value_text(value))
        about = escape(f"{path + ': ' if path else ''}{tolerance_text(value)}; confirmed by {value.confirmed_by}")
        note = f"<sup>{letters[_kind(_reason(value))]}</sup>" if letters else ""
        if path is None:
            return f'<span title="{about}">{text}</span>{note}'
        return f'<a class="n" href="#{_anchor("n", path)}" title="{about}">{text}</a>{note}'

    def _notes(self, table: Table, letters: Mapping[str, str], reasons: Mapping[str, str]) -> str:
        notes = [_marked(table.note)] if table.note else []
        for kind, why in reasons.items():
            if why:
                mark = f"<sup>{letters[kind]}</sup> " if letters else ""
                said = why[0].upper() + why[1:] if why.startswith(("given", NO_VALUE)) else f"Confirmed by {why}"
                notes.append(f"{mark}{_marked(said)}{'' if said.endswith(('…', '.')) else '.'}")
        return f'<p class="note">{"<br>".join(notes)}</p>\n' if notes else "\n"

    # --- appendices -------------------------------------------------------------------------------------------------

    def _defined(self) -> dict[str, str]:
        """Return the definitions that the report's numbers need, in their order."""
        found = [definition(path, self.more) for path in self.numbers]
        return dict(f for f in found if f is not None)

    def _appendix(self) -> str:
        if not self.numbers:
            return ""
        reasons = list(dict.fromkeys(n.confirmed_by for n in self.numbers.values()))
        out = [_NUMBERS]
        for top in dict.fromkeys(path.partition(".")[0] for path in self.numbers):
            lines = []
            for path, number in self.numbers.items():
                if path.partition(".")[0] != top:
                    continue
                known = definition(path, self.more)
                shown = _breakable(path)
                if known is not None:
                    shown = f'<a class="n" href="#{_anchor("d", known[0])}" title="{escape(known[1])}">{shown}</a>'
                lines.append(
                    f'<tr id="{_anchor("n", path)}"><td class="path">{shown}</td>'
                    f'<td class="right">{escape(value_text(number, 10))}</td>'
                    f"<td>{escape(symbol(number.unit))}</td>"
                    f'<td class="right">{escape(tolerance_text(number))}</td>'
                    f'<td class="right"><a class="n" href="#why{reasons.index(number.confirmed_by) + 1}">'
                    f"[{reasons.index(number.confirmed_by) + 1}]</a></td></tr>\n"
                )
            out.append(
                '<div class="table long"><table class="dense numbers">\n<thead><tr><th scope="col">path</th>'
                '<th scope="col" class="right">value</th><th scope="col">unit</th><th scope="col" class="right">'
                'tolerance</th><th scope="col" class="right">confirmed</th></tr></thead>\n<tbody>\n'
                f"{''.join(lines)}</tbody>\n</table></div>\n"
            )
        out.append("<h3>Confirmed by</h3>\n<ol class=why>\n")
        out += [f'<li id="why{i}">{_marked(why) or "–"}</li>\n' for i, why in enumerate(reasons, 1)]
        out.append("</ol>\n</section>\n")
        defined = self._defined()
        if defined:
            out.append('<section id="definitions" class="level2">\n<h2><span class="no">B</span> Definitions</h2>\n')
            out.append(f"<p>{_marked(LOOP)}</p>\n" if LOOP_TERMS & set(defined) else "")
            out.append('<div class="table long"><table class="definitions">\n')
            out += [
                f'<tr id="{_anchor("d", term)}"><th scope="row"><code>{_breakable(term)}</code></th>'
                f"<td>{_marked(text)}</td></tr>\n"
                for term, text in defined.items()
            ]
            out.append("</table></div>\n</section>\n")
        return "".join(out)


def _anchor(kind: str, key: str) -> str:
    """Return an id: a letter for what it is, then the key, in characters that need no quoting in a link."""
    return f"{kind}-" + re.sub(r"[^A-Za-z0-9._-]", lambda m: f"_{ord(m[0]):x}_", key)


def _marked(text: str) -> str:
    """Escape a text; what stands between backticks is code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text))


def _breakable(path: str) -> str:
    return escape(path).replace(".", ".<wbr>").replace("_", "_<wbr>")


def _paragraphs(texts: Sequence[str]) -> str:
    """Return paragraphs; texts that begin with "- " are the items of a list."""
    out, items = [], False
    for text in texts:
        item = text.startswith("- ")
        if item != items:
            out.append("<ul>\n" if item else "</ul>\n")
            items = item
        out.append(f"<li>{_marked(text[2:])}</li>\n" if item else f"<p>{_marked(text)}</p>\n")
    return "".join(out) + ("</ul>\n" if items else "")


def _kind(reason: str) -> str:
    """Return how a number was confirmed without the numbers in it."""
    return re.sub(r"[-−]?\d[\d.]*(?:e[-+]?\d+)?(?:, [-−]?\d[\d.]*(?:e[-+]?\d+)?)*", "…", reason)


def _grouped(reasons: Iterable[str]) -> dict[str, str]:
    """Return each kind of confirmation once: as it is where that is the same for all, else without its numbers."""
    found: dict[str, str] = {}
    for reason in reasons:
        kind = _kind(reason)
        found[kind] = kind if found.get(kind, reason) != reason else reason
    return found


def _common_unit(table: Table, column: int) -> str | None:
    """Return the unit of all numbers in a column; None where they differ."""
    units = {row[column].unit for row in table.rows if column < len(row) and isinstance(row[column], Number)}
    if not units:
        return "1"
    return units.pop() if len(units) == 1 else None


def _says(heading: str, unit: str) -> bool:
    """Return whether a heading names the unit already."""
    words = re.split(r"[\s(),\[\]]+", str(heading))
    return not {unit, symbol(unit), f"/{unit}"}.isdisjoint(words)


def _right(yes: bool) -> str:
    return ' class="right"' if yes else ""


def _reason(number: Number) -> str:
    """Return how a number was confirmed, or why there is none."""
    return f"{NO_VALUE}: {number.confirmed_by}" if math.isnan(number.value) else number.confirmed_by


def _letter(i: int) -> str:
    return chr(97 + i) if i < 26 else _letter(i // 26 - 1) + chr(97 + i % 26)
