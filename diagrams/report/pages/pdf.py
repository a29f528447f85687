"""A report as PDF: the same page as in a browser, laid out by PlutoPrint, which brings all that it needs.

Its pages are filled: a summary of two sheets, and no large gaps, for which figures are set smaller, and tables go over.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ....blocks.core import accepts, kinds
from ...drawing import printer

GAP = 0.14
"""Share of a page that may stay empty at its end."""
LEAST = 0.62
"""Smallest factor by which a figure is set smaller."""
_CAPTION = 0.065
"""Share of a page that a caption takes, with the space around it."""
ROWS, WIDE_GAP = (12, 5), 0.19
"""Rows above which a table may go over to the next page to fill one: to fill a gap, and one of this share of a page."""
_TABLE_PART = 0.2
"""Share of a page that has to be free for the first part of such a table."""
MOST = 24
"""Changes after which pages are left as they are."""
TOP, BOTTOM = 18.0 / 25.4 * 72, 18.0 / 25.4 * 72
"""Margins of a page in points, as in the style sheet."""
MARK = 2.0
"""Height of a mark in points; marks are at the text's left edge ahead of each figure and table."""

_SHEETS = 2
"""Sheets of a summary."""
SMALLER, SMALLEST = 0.9, 0.6
"""Factor by which the figures of a summary are set smaller at once, and the smallest of all."""
_SMALL, _END = '<div class="picture">', '<nav aria-label="Contents">'
"""Beginning of a small figure's picture, and what follows the summary."""
_PLACE = re.compile(
    r"""<figure\sid="[^"]*"[^>]*>(?:\s*<div\sclass="scroll">\s*<svg)?|(?:<div\sclass="keep">\s*<h\d.*?</h\d>\s*)?<div\sclass="table(\slong)?">"""
)
_WIDTH = re.compile(r'<svg[^>]*?\bwidth="([\d.]+)(pt|px)?"')
_TEXT_WIDTH = (210 - 37) / 25.4 * 96
"""Width of the text of an A4 page in pixels."""


def pdf_printer() -> Any:
    """Return the library that lays a report out for print, or raise an error that says how to install it."""
    return printer("a PDF", "print the HTML page from a browser", "pdf")


PAPERS = ("A4", "letter")
PAPER = kinds.choice(*PAPERS).worded(f"one of {', '.join(PAPERS)}", "Choose one of them.")


@accepts(None, paper=PAPER)
def write_pdf(html: str, path: str | os.PathLike[str], paper: str = "A4") -> int:
    """Write a page as PDF; return the number of its pages."""
    library = pdf_printer()
    size = library.PAGE_SIZE_LETTER if paper == "letter" else library.PAGE_SIZE_A4

    def lay_out(page: str) -> Any:
        book = library.Book(size, library.PAGE_MARGINS_NONE, library.MEDIA_TYPE_PRINT)
        book.load_html(page, base_url="file:///report.html")
        return book

    book = lay_out(fill_pages(_fit_summary(html, lay_out), lay_out, library.ImageCanvas))
    book.write_to_pdf(str(Path(path)))
    return int(book.get_page_count())


@dataclass
class Changes:
    """Changes of a page's figures and tables, by their place among them."""

    smaller: dict[int, float] = field(default_factory=dict)
    """Factors of figures."""
    over: set[int] = field(default_factory=set)
    """Tables that may go over to the next page."""
    left: set[int] = field(default_factory=set)
    """Figures that no smaller size brings onto the sheet before."""


@dataclass(frozen=True)
class _PagePlace:
    """A figure or table on a page: its place among all, and where it begins, in points from the page's text area."""

    index: int
    begin: float


def _fit_summary(html: str, lay_out: Any) -> str:
    """Return a page for print whose summary has `_SHEETS` sheets at most, if smaller figures there suffice for that."""
    end = html.find(_END)
    summary, rest = (html, "") if end < 0 else (html[:end], html[end:])
    if _SMALL not in summary:
        return html
    factor, fitted = 1.0, summary
    while lay_out(f"{fitted}</main></body></html>").get_page_count() > _SHEETS:
        factor *= SMALLER
        if factor < SMALLEST:
            return html
        fitted = summary.replace(_SMALL, f'<div class="picture" style="max-width:{100 * factor:.0f}%">')
    return fitted + rest


def fill_pages(html: str, lay_out: Any, canvas: Any) -> str:
    """Return a page for print whose gaps at the ends of sheets are small where that can be had.

    A figure that just misses the end of a sheet is set smaller, by `LEAST` at most; a table of more than `ROWS` rows
    that leaves much of a sheet empty may go over to the next one, where its head is repeated.
    """
    places = list(_PLACE.finditer(html))
    if not places:
        return html
    changes, page, tried = Changes(), 0, 0
    while tried < MOST:
        book = lay_out(_changed(html, changes, marked=True))
        count = book.get_page_count()
        while page + 1 < count and not _change(html, places, changes, book, canvas, page):
            page += 1
        if page + 1 >= count:
            break
        tried += 1
    return _changed(html, changes, marked=False)


def _change(html: str, places: list[re.Match[str]], changes: Changes, book: Any, canvas: Any, page: int) -> bool:
    """Change what begins the next sheet if this one has a large gap; return whether anything was changed."""
    size = book.get_page_size_at(page)
    height = size.height - TOP - BOTTOM
    filled, _ = _look(book, canvas, page, len(places))
    free = height - filled
    if free <= GAP * height:
        return False
    filled_next, following = _look(book, canvas, page + 1, len(places))
    if not following or following[0].begin > 0.2 * height:
        return False
    first = following[0]
    index, found = first.index, places[first.index]
    if index in changes.over or index in changes.left:
        return False
    if found[0].startswith("<figure"):
        end = html.find("</figure>", found.start())
        if 'class="paper"' in html[found.start() : end] or "<svg" not in found[0]:
            return False
        before = changes.smaller.get(index)
        if before is None:
            end_of_it = following[1].begin if len(following) > 1 else filled_next
            tall, caption = end_of_it - first.begin, _CAPTION * height
            factor = min((free - first.begin - caption) / max(tall - caption, 1.0), 0.98)
        else:
            factor = 0.93 * before
        if factor >= LEAST:
            changes.smaller[index] = factor
        else:
            changes.smaller.pop(index, None)
            changes.left.add(index)
        return factor >= LEAST or before is not None
    rows = html.count("<tr", found.start(), html.find("</table>", found.start())) - 1
    least = ROWS[free > WIDE_GAP * height]
    if found[1] or rows <= least or free - first.begin < _TABLE_PART * height:
        return False
    changes.over.add(index)
    return True


def _changed(html: str, changes: Changes, *, marked: bool) -> str:
    """Return the page with its changes, and a mark ahead of each figure and table, which is seen or not."""
    index = -1

    def change(found: re.Match[str]) -> str:
        nonlocal index
        index += 1
        color = f"background:rgb(254,{1 + index // 250},{1 + index % 250})" if marked else ""
        mark = f'<div style="display:block;height:{MARK}pt;width:4pt;{color}"></div>'
        text = found[0]
        if index in changes.over:
            text = text.replace('class="keep"', 'class="parted"').replace('class="table"', 'class="table long"')
        if index in changes.smaller:
            natural = _WIDTH.search(html, found.start())
            width = _TEXT_WIDTH
            if natural is not None:
                width = min(width, float(natural[1]) * (4 / 3 if natural[2] == "pt" else 1.0))
            limit = f'<div class="scroll" style="max-width:{changes.smaller[index] * width:.0f}px">'
            text = text.replace('<div class="scroll">', limit)
        begin, close, rest = text.rpartition('class="table') if "<figure" not in text else ("", "", text)
        of_its_own, end, inner = rest.partition(">")
        return begin + close + of_its_own + end + mark + inner

    return _PLACE.sub(change, html)


def _look(book: Any, canvas: Any, page: int, count: int) -> tuple[float, list[_PagePlace]]:
    """Return how far a sheet is filled, in points from its text area's top, and those of all places that are on it."""
    size = book.get_page_size_at(page)
    wide, high = int(size.width), int(size.height)
    image = canvas(wide, high)
    image.scale(0.75, 0.75)
    book.render_page(image, page)
    data = np.frombuffer(image.get_data(), dtype=np.uint8).reshape(high, -1)[:, : 4 * wide].reshape(high, wide, 4)
    area = data[int(TOP) : int(size.height - BOTTOM)]
    inked = np.flatnonzero(np.any(np.min(area[:, :, :3], axis=2).astype(int) + 24 < area[:, :, 3], axis=1))
    filled = float(inked[-1] + 1) if inked.size else 0.0
    edge = area[:, int(20 / 25.4 * 72) : int(20 / 25.4 * 72) + 6]
    rows, columns = np.nonzero((edge[:, :, 2] == 254) & (edge[:, :, 3] == 255) & (edge[:, :, 1] < 20))
    seen: dict[int, float] = {}
    for row, column in zip(rows, columns, strict=True):
        index = 250 * (int(edge[row, column, 1]) - 1) + int(edge[row, column, 0]) - 1
        if 0 <= index < count:
            seen.setdefault(index, float(row))
    return filled, sorted((_PagePlace(index, begin) for index, begin in seen.items()), key=lambda place: place.begin)
