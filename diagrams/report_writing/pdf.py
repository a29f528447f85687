"""A report as PDF: the same page as in a browser, laid out by PlutoPrint, which brings all that it needs."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from ...blocks.core import OptionError


def printer() -> Any:
    """Return the library that lays pages out.

    Raises
    ------
    OptionError
        It is not installed.
    """
    try:
        import plutoprint
    except ImportError as error:
        raise OptionError(
            'a PDF needs PlutoPrint, which is not installed. Install it: pip install "loopwright[pdf]"; or print the '
            "HTML page from a browser.",
            port="pdf",
        ) from error
    return plutoprint


def write_pdf(html: str, path: str | os.PathLike[str]) -> int:
    """Write a page as PDF, A4; return the number of its pages.

    Parameters
    ----------
    html : str
        The report's page.
    path : path
        The file.
    """
    library = printer()
    book = library.Book(library.PAGE_SIZE_A4, library.PAGE_MARGINS_NONE, library.MEDIA_TYPE_PRINT)
    book.load_html(html, base_url="file:///report.html")
    book.write_to_pdf(str(Path(path)))
    return int(book.get_page_count())
