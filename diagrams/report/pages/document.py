"""Content of a report: sections with text, tables, figures, and numbers by dotted paths; declarations of tables."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from ....blocks.core import Grid, Sheet, ShownAsTable, brief, explain_calls
from ...frequency import Number
from ...requirements import Review, Verdict

SUMMARY = "summary"
"""Key of the section that begins a report and can stand alone."""


@explain_calls
@dataclass(frozen=True)
class Table(ShownAsTable, Grid):
    """A table: a title, column headings, and rows of texts or numbers.

    One of ``details`` is in the appendix. Numbers have ``digits`` significant digits at most, fewer where their
    tolerance bears no more. Columns without a single entry are not shown. ``terms`` names the definitions of numbers
    that have no dotted path, by their columns; ``numbers`` has those with a path within the section. A ``brief`` table
    repeats numbers of other tables: of their confirmations it has only those that say less than "confirmed".
    """

    details: bool = False
    digits: int = 6
    terms: Mapping[str, str] = field(default_factory=dict)
    numbers: Mapping[str, Number] = field(default_factory=dict)
    brief: bool = False

    def __repr__(self) -> str:
        facts = f"{len(self.rows)} rows", ", ".join(map(str, self.columns))
        return brief(f"table {self.title!r}", *facts, then=".rows")

    def _sheet(self) -> Sheet:
        return Sheet("", (), (self,))


@dataclass(frozen=True)
class TableForm:
    """Declaration of a table: the facts of a row that its columns show, and the paths of the row's numbers.

    ``columns`` has the facts by heading, and ``paths`` the paths within the section by fact, such as
    ``"{key}.slowest"``: other facts of the row fill the braces. A number need not be shown to have a path. Braces in
    the title and in headings are filled with what `fill` is given.
    """

    title: str
    columns: Mapping[str, str]
    paths: Mapping[str, str] = field(default_factory=dict)
    terms: Mapping[str, str] = field(default_factory=dict)
    details: bool = False
    digits: int = 6

    def fill(self, rows: Iterable[Mapping[str, Any]], note: str = "", **facts: Any) -> Table:
        """Return the table of rows of facts; a fact that a row doesn't have is an empty entry."""
        rows = list(rows)
        found = ((path.format(**row), row.get(fact)) for row in rows for fact, path in self.paths.items())
        return Table(
            self.title.format(**facts),
            tuple(heading.format(**facts) for heading in self.columns),
            tuple(tuple(row.get(fact) for fact in self.columns.values()) for row in rows),
            note,
            self.details,
            self.digits,
            self.terms,
            {path: number for path, number in found if isinstance(number, Number)},
        )


def compare_columns(
    title: str,
    names: Mapping[str, str],
    columns: Iterable[tuple[str, Mapping[str, Any]]],
    note: str = "",
    **options: Any,
) -> Table:
    """Return a table with a row for each name, in words, and a column for each heading with its values by name."""
    pairs = list(columns)
    rows = tuple((words, *(values.get(name) for _, values in pairs)) for name, words in names.items())
    return Table(title, ("", *(heading for heading, _ in pairs)), rows, note, **options)


class Judged(str):
    """A text that is shown in the color of its verdict: a cell of a table, or a paragraph.

    Its ``reason`` is a part of the text, after a colon; that of a cell is below the table, by a letter.
    """

    verdict: Verdict
    reason: str
    short: str
    """The text without the reason."""

    def __new__(cls, text: str, verdict: Verdict, reason: str = "") -> Judged:
        """Make a text with its verdict."""
        made = super().__new__(cls, f"{text}: {reason}" if reason else text)
        made.verdict, made.reason, made.short = verdict, reason, text
        return made


class _DrawnWhenAsked:
    """The figure of a plot. Where the plot has a function that draws it, this calls it once, when it is first asked."""

    def __get__(self, plot: Plot | None, owner: type | None = None) -> Any:
        if plot is None:
            raise AttributeError("figure")  # so that the field has no default
        given = plot.__dict__["figure"]
        if callable(given):
            given = plot.__dict__["figure"] = given()
        return given

    def __set__(self, plot: Plot, given: Any) -> None:
        plot.__dict__["figure"] = given


@explain_calls
@dataclass(frozen=True, eq=False)
class Plot:
    """A figure: a key for its file, a caption, the matplotlib figure or the `Drawing`; ``ahead`` of the tables or not.

    In place of the figure it can have a function without arguments that draws it: who reads the numbers alone waits for
    no figure. One of ``details`` is in the appendix. Figures with the same ``group`` are small and stand side by
    side.
    """

    key: str
    caption: str
    figure: Any = _DrawnWhenAsked()
    ahead: bool = False
    details: bool = False
    group: str = ""

    def __repr__(self) -> str:
        return brief(f"figure {self.key!r}", self.caption[:80], then=".figure")

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "figure": self.figure}


@explain_calls
@dataclass(frozen=True, eq=False)
class Section:
    """A section: what it is about in words, then tables and figures; ``key`` starts the paths of its numbers."""

    key: str
    title: str
    text: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    plots: tuple[Plot, ...] = ()
    numbers: Mapping[str, Number] = field(default_factory=dict)
    """By path within the section, such as ``par.sampled_d0.phase_margin_deg``; those of the tables are among them."""
    sections: tuple[Section, ...] = ()
    overview: tuple[Plot, ...] = ()
    """Small figures of it for the summary."""
    absent: Mapping[str, str] = field(default_factory=dict)
    """Reasons why numbers are missing, by the beginnings of their paths within the section."""

    def __post_init__(self) -> None:
        of_tables = {path: number for table in self.tables for path, number in table.numbers.items()}
        object.__setattr__(self, "numbers", {**self.numbers, **of_tables, **self.numbers})

    def __repr__(self) -> str:
        facts = (
            f"{len(self.tables)} tables",
            f"{len(self.plots)} figures",
            f"{len(self.numbers)} numbers",
            f"{len(self.sections)} parts",
        )
        return brief(f"section {self.title!r}", *facts, then=".text, .tables, .plots, .sections")


@explain_calls
@dataclass(frozen=True, eq=False)
class Document:
    """Sections with their numbers, and what they are about.

    Attributes
    ----------
    title : str
        Its heading.
    sections : tuple of Section
        In order.
    meta : mapping
        Subject of the analysis, its time, and the versions of the libraries.
    review : Review, optional
        Verdicts on the requirements; None where none were given.
    summary : bool
        Whether its page has the summary alone. Its numbers are the same.
    appendix : bool
        Whether its page has the appendix: all numbers, definitions and details.
    """

    title: str
    sections: tuple[Section, ...]
    meta: Mapping[str, Any] = field(default_factory=dict)
    review: Review | None = None
    summary: bool = False
    appendix: bool = True

    def __repr__(self) -> str:
        verdict = "" if self.review is None else self.review.verdict.value
        facts = f"{len(self.sections)} sections", f"{len(self.numbers())} numbers", verdict
        return brief(f"report {self.title!r}", *facts, then=".numbers(), .sections, .save(…)")

    def numbers(self) -> dict[str, Number]:
        """Return every number by its dotted path, such as ``inner.par.sampled_d0.phase_margin_deg``."""
        return {here + path: n for here, section in self._walk() for path, n in section.numbers.items()}

    def absent(self) -> dict[str, str]:
        """Return the reasons why numbers are missing, by the beginnings of their paths."""
        return {here + path: why for here, section in self._walk() for path, why in section.absent.items()}

    def _walk(self) -> Iterator[tuple[str, Section]]:
        """Yield each section with the beginning of its paths."""

        def walk(sections: Iterable[Section], prefix: str) -> Iterator[tuple[str, Section]]:
            for section in sections:
                here = f"{prefix}{section.key}."
                yield here, section
                yield from walk(section.sections, here)

        yield from walk(self.sections, "")
