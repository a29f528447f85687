"""A report as PDF: the same page as in a browser, laid out by PlutoPrint, which brings all that it needs."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from ....blocks.core import accepts, kinds
from ...drawing import printer
from .filled_pages import fill_pages, fit_summary


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

    book = lay_out(fill_pages(fit_summary(html, lay_out), lay_out, library.ImageCanvas))
    book.write_to_pdf(str(Path(path)))
    return int(book.get_page_count())
