"""Pages of a PDF: no large gaps before figures and tables, and everything is still there."""

import re

import numpy as np
import plutoprint
import pypdfium2
import pytest
from matplotlib.figure import Figure

from loopwright.diagrams.report.pages.document import Plot, Section, Table
from loopwright.diagrams.report.pages.html import to_html
from loopwright.diagrams.report.pages.pdf import LEAST, fill_pages, write_pdf
from loopwright.diagrams.report.pages.report import Report

TALL, WIDE = 3.3, 6.6


def curve():
    figure = Figure(figsize=(WIDE, TALL))
    figure.subplots().plot([0, 1], [1, 0])
    return figure


def report(lines, rows=11, figures=2):
    """Return a report with text, a table and figures, each of which must stay whole."""
    table = Table("T", ("name", "value"), tuple((f"row{i}", float(i)) for i in range(rows)))
    plots = tuple(Plot(f"p{i}", "A figure.", curve()) for i in range(figures))
    return Report("R", (Section("a", "First", ("Filling.",) * lines, (table,), plots), Section("b", "Last", ("End.",))))


def gaps(file):
    """Return the empty share at the end of each sheet but the last, and the text of all."""
    document = pypdfium2.PdfDocument(file)
    found, text = [], ""
    for page in document:
        text += page.get_textpage().get_text_range()
        ink = np.asarray(page.render(scale=0.5).to_pil().convert("L")) < 250
        high = len(ink)
        filled = np.flatnonzero(ink[int(high * 18 / 297) : int(high * 278 / 297)].any(axis=1))
        found.append(1 - (filled[-1] + 1) / (high * 260 / 297))
    document.close()
    return found[:-1], text


@pytest.mark.parametrize(
    ("lines", "paper"),
    [
        (22, "A4"),
        *(pytest.param(lines, paper, marks=pytest.mark.slow) for lines in (10, 16, 27) for paper in ("A4", "letter")),
    ],
)
def test_sheets_are_filled_where_a_figure_or_table_would_leave_them_empty(lines, paper, tmp_path):
    write_pdf(to_html(report(lines)), tmp_path / "r.pdf", paper)
    found, text = gaps(tmp_path / "r.pdf")
    assert max(found) < 0.34  # a figure and its caption fill a third: one that fits at no allowed size stays
    assert [text.count(f"Figure {i}.") for i in (1, 2)] == [1, 1]
    assert all(text.count(f"row{i}\r") + text.count(f"row{i} ") == 1 for i in range(11))


def test_a_figure_that_just_misses_a_sheets_end_is_set_smaller_and_no_smaller_than_allowed(tmp_path):
    def lay_out(page):
        book = plutoprint.Book(plutoprint.PAGE_SIZE_A4, plutoprint.PAGE_MARGINS_NONE, plutoprint.MEDIA_TYPE_PRINT)
        book.load_html(page, base_url="file:///report.html")
        return book

    counts, factors = [], []
    for lines in (14, 17, 20):
        html = to_html(report(lines, rows=3))
        filled = fill_pages(html, lay_out, plutoprint.ImageCanvas)
        counts.append(lay_out(html).get_page_count() - lay_out(filled).get_page_count())
        factors += [float(width) / (WIDE * 96) for width in re.findall(r'style="max-width:(\d+)px"', filled)]
    assert min(counts) >= 0
    small = [factor for factor in factors if factor < 1]
    assert small
    assert min(small) >= LEAST - 0.02


def test_a_page_without_figures_and_tables_stays_as_it_is():
    assert fill_pages("<p>text</p>", None, None) == "<p>text</p>"


@pytest.mark.parametrize("lines", [22, 23])
def test_a_heading_stays_with_the_long_table_below_it(lines, tmp_path):
    table = Table("LONG", ("name", "value"), tuple((f"row{i}", float(i)) for i in range(40)))
    part = Section("p", "HEADING", tables=(table,))
    made = Report("R", (Section("a", "First", ("Filling.",) * lines), Section("b", "B", ("Text.",), sections=(part,))))
    write_pdf(to_html(made), tmp_path / "r.pdf")
    document = pypdfium2.PdfDocument(tmp_path / "r.pdf")
    sheets = [page.get_textpage().get_text_range() for page in document]
    document.close()
    (at,) = [sheet for sheet in sheets if "HEADING" in sheet and "row" in sheet]
    assert "row0" in at
    assert "LONG" in at
