"""The content of a report's page, as its templates show it: everything numbered, with anchors, nothing escaped yet."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from ....blocks.core import print_unit
from ...frequency import Number
from .definitions import LOOP_TERMS, definition
from .document import SUMMARY, Document, Plot, Section, Table
from .page_tables import Numbered, TableView, anchor
from .printed_values import cell, mark, reason, tolerance_text, value_text
from .svg import EmbeddedFigure, embedded

ELSEWHERE = frozenset({"definitions", "versions", "variants", "fmus"})
"""Entries of ``meta`` that sections show."""
ITEM = "- "
"""Beginning of a text that is an item of a list."""


@dataclass(frozen=True)
class FigureView:
    """A figure with its number."""

    number: int
    anchor: str
    caption: str
    picture: EmbeddedFigure


@dataclass(frozen=True)
class LinkView:
    """A link to another place of the page."""

    text: str
    anchor: str


@dataclass(frozen=True)
class DetailsView:
    """Tables and figures of a section that are in the appendix."""

    title: str
    anchor: str
    tables: tuple[TableView, ...]
    figures: tuple[FigureView, ...] = ()


@dataclass(frozen=True)
class SectionView:
    """A section with its number, such as "1.2"; ``level`` is that of its heading."""

    number: str
    anchor: str
    level: int
    title: str
    text: tuple[tuple[bool, tuple[str, ...]], ...]
    """Paragraphs, and lists (True) of items."""
    drawings: tuple[FigureView, ...]
    tables: tuple[TableView, ...]
    figures: tuple[FigureView, ...]
    sections: tuple[SectionView, ...]
    groups: tuple[tuple[FigureView, ...], ...] = ()
    """Small figures that stand side by side."""
    details: tuple[LinkView, ...] = ()
    """Tables of it that are in the appendix."""

    @property
    def kept(self) -> bool:
        """Whether the heading is kept together with the first thing below it, which is no text."""
        return not self.text and any(not isinstance(of, TableView) or not of.is_long for of in self._first())

    @property
    def heads_long(self) -> bool:
        """Whether a table that may go over to the next page follows the heading at once."""
        return not self.text and any(isinstance(of, TableView) and of.is_long for of in self._first())

    def _first(self) -> tuple[FigureView | TableView, ...]:
        shown: tuple[FigureView | TableView, ...] = (*self.drawings, *self.tables, *self.figures)
        return shown[:1]


@dataclass(frozen=True)
class NumberView:
    """A line of the appendix: a number by its dotted path."""

    path: str
    anchor: str
    value: str
    unit: str
    tolerance: str
    reason: int
    """Number of its confirmation in the list below."""
    term: TermView | None


@dataclass(frozen=True)
class TermView:
    """A term with its definition."""

    term: str
    anchor: str
    definition: str


@dataclass(frozen=True)
class Page:
    """A report's page."""

    title: str
    about: tuple[tuple[str, str], ...]
    """Names and values of the lines below the title."""
    summary: SectionView | None
    """The section that can stand alone; None where the report has none."""
    sections: tuple[SectionView, ...]
    """The chapters: all other sections; none where there is only the summary."""
    numbers: tuple[tuple[NumberView, ...], ...]
    """All numbers, by their sections."""
    reasons: tuple[str, ...]
    """Computations that confirmed the numbers."""
    terms: tuple[TermView, ...]
    defines_loop: bool
    """Whether terms take the loop for granted, so that it is defined as well."""
    details: tuple[DetailsView, ...] = ()
    """Tables of the appendix, by the sections that they belong to."""

    @property
    def contents(self) -> tuple[SectionView, ...]:
        """The summary and the chapters, as the table of contents lists them."""
        return (*(() if self.summary is None else (self.summary,)), *self.sections)

    @classmethod
    def of(cls, report: Document) -> Page:
        """Return the page of a report: all of it, without the appendix, or the summary alone."""
        numbers = report.numbers()
        with_appendix = report.appendix and not report.summary
        more: Mapping[str, str] = report.meta.get("definitions") or {}
        reasons = list(dict.fromkeys(map(reason, numbers.values())))
        known = {path: _term(path, more) for path in numbers}
        lines = [
            NumberView(
                path,
                anchor("n", path),
                value_text(number, 10) + mark(number),
                print_unit(number.unit),
                tolerance_text(number),
                reasons.index(reason(number)) + 1,
                known[path],
            )
            for path, number in numbers.items()
        ]
        tops = dict.fromkeys(path.partition(".")[0] for path in numbers)
        numbering = _Numbering(numbers, with_appendix=with_appendix)
        # The summary has no number, so that chapters begin with 1.
        begins = 1 if report.sections and report.sections[0].key == SUMMARY else 0
        first = numbering.sections(report.sections[:begins], "", "")
        chapters = () if report.summary else numbering.sections(report.sections[begins:], "", "", begins + 1)
        summary = first[0] if first else None
        about = tuple(_about(report.meta))
        # Numbers without the appendix have no place that they could link to.
        if not with_appendix:
            return cls(report.title, about, summary, chapters, (), (), (), defines_loop=False)
        details = numbering.details()
        of_tables = (_term(term, more) for term in numbering.tables.terms)
        terms = tuple(dict.fromkeys(term for term in (*known.values(), *of_tables) if term is not None))
        return cls(
            report.title,
            about,
            summary,
            chapters,
            tuple(tuple(line for line in lines if line.path.partition(".")[0] == top) for top in tops),
            tuple(reasons),
            terms,
            not LOOP_TERMS.isdisjoint(term.term for term in terms),
            details,
        )


class _Numbering:
    """Sections, tables and figures of a page, numbered in the order in which they are shown."""

    def __init__(self, numbers: Mapping[str, Number], *, with_appendix: bool):
        self.tables, self.with_appendix = Numbered(numbers, linked=with_appendix), with_appendix
        self.figures: dict[str, None] = {}
        self.left: list[tuple[str, str, tuple[Table, ...], tuple[Plot, ...]]] = []
        """Titles and anchors of sections with their tables and figures for the appendix."""

    def details(self) -> tuple[DetailsView, ...]:
        """Return the tables and figures of the appendix, numbered after all others."""
        return tuple(
            DetailsView(title, name, tuple(map(self.tables.view, tables)), tuple(map(self._figure, plots)))
            for title, name, tables, plots in self.left
        )

    def sections(
        self, sections: Sequence[Section], prefix: str, number: str, first: int = 1
    ) -> tuple[SectionView, ...]:
        """Return sections of one level, numbered from the first one's number."""
        return tuple(self._section(s, prefix + s.key, f"{number}{i}") for i, s in enumerate(sections, first))

    def _section(self, section: Section, key: str, number: str) -> SectionView:
        ahead = tuple(self._figure(plot) for plot in section.plots if plot.ahead and not plot.details)
        later = tuple(table for table in section.tables if table.details and self.with_appendix)
        drawn = tuple(plot for plot in section.plots if plot.details and self.with_appendix)
        if later or drawn:
            self.left.append((f"{number} {section.title}", anchor("x", key), later, drawn))
        return SectionView(
            number,
            anchor("s", key),
            min(number.count(".") + 2, 4),
            section.title,
            tuple((listed, tuple(texts)) for listed, texts in _grouped(section.text)),
            ahead,
            tuple(self.tables.view(table) for table in section.tables if not table.details),
            tuple(self._figure(plot) for plot in section.plots if not (plot.ahead or plot.details or plot.group)),
            self.sections(section.sections, f"{key}.", f"{number}."),
            tuple(
                tuple(map(self._figure, group))
                for _, group in groupby((plot for plot in section.plots if plot.group), lambda plot: plot.group)
            ),
            tuple(LinkView(text, anchor("x", key)) for text in (*(t.title for t in later), *_titles(drawn))),
        )

    def _figure(self, plot: Plot) -> FigureView:
        key = plot.key
        while key in self.figures:
            key += "_"
        self.figures[key] = None
        name = anchor("f", key)
        return FigureView(len(self.figures), name, plot.caption, embedded(plot.figure, name, plot.caption))


def _titles(plots: Sequence[Plot]) -> tuple[str, ...]:
    """Return the captions of figures, to be linked: without their stop."""
    return tuple(plot.caption.rstrip(".") for plot in plots)


def _term(path: str, more: Mapping[str, str]) -> TermView | None:
    found = definition(path, more)
    return None if found is None else TermView(found[0], anchor("d", found[0]), found[1])


def _grouped(texts: Sequence[str]) -> Any:
    """Yield paragraphs and the lists among them, with True for lists, without the marks of their items."""
    for listed, group in groupby(texts, lambda text: text.startswith(ITEM)):
        yield listed, [text.removeprefix(ITEM) if listed else text for text in group]


def _about(meta: Mapping[str, Any]) -> Any:
    """Yield the names and values of what was analysed, when and with which versions."""
    for key, value in meta.items():
        if key in ELSEWHERE or value in (None, "", {}, ()):
            continue
        if key == "revision" and re.fullmatch(r"[0-9a-f]{64}", str(value)):  # the JSON has all digits
            value = f"{value[:12]}… (digest of the diagram: its blocks, wires, parameters and FMUs)"
        if isinstance(value, Mapping):
            pairs = {str(k): cell(v) for k, v in value.items()}
            plainly = all(len(text.split()) == 1 for text in pairs.values())
            said = [v if k == v else f"{k}{' ' if plainly else ': '}{v}" for k, v in pairs.items()]
            value = (", " if plainly else "; ").join(said)
        elif isinstance(value, list | tuple):
            value = ", ".join(map(cell, value))
        yield str(key).replace("_", " "), cell(value)
