"""A report, which a notebook shows as a page, and its files."""

from __future__ import annotations

import os
from dataclasses import dataclass
from html import escape
from pathlib import Path

from ....blocks.core import OptionError, accepts, check_file, explain_calls, replace_file, write_text
from .document import Document
from .html import to_html
from .json import to_json
from .pdf import PAPER, pdf_printer, write_pdf


@explain_calls
@dataclass(frozen=True, eq=False, repr=False)
class Report(Document):
    """A design report of a diagram.

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

    def _repr_html_(self) -> str:
        """Show it in a notebook, in a separate inner page: its styles are meant for a whole page."""
        page = escape(to_html(self), quote=True)
        return f'<iframe srcdoc="{page}" style="width:100%;height:45em;border:1px solid #d5dbe1"></iframe>'


@accepts(None, paper=PAPER)
def check_files(path: str | os.PathLike[str] | None, *, pdf: bool, json: bool, paper: str = "A4") -> None:
    """Find out, before anything is computed, whether the files of a report can be written."""
    if path is None:
        if pdf or json:
            raise OptionError(
                'a PDF or JSON is written next to the page; give its path, such as "fig3.html".', port="path"
            )
        return
    file = Path(path).expanduser()
    if file.suffix.lower() not in (".html", ".htm"):
        step = f" Name it {file.stem}.html."
        if file.suffix.lower() in (".pdf", ".json"):
            step = f" Name it {file.stem}.html, and ask for the {file.suffix[1:].upper()} next to it."
        raise OptionError(f"found {str(path)!r}; expected a file that ends in .html.{step}", port="path")
    check_file(path)
    if pdf:
        pdf_printer()


def write_report(
    report: Document,
    path: str | os.PathLike[str] | None,
    *,
    pdf: bool = False,
    json: bool = False,
    paper: str = "A4",
) -> list[Path]:
    """Write a report's page and, next to it, its PDF and its numbers; return the files."""
    if path is None:
        return []
    file = Path(path).expanduser()
    page = to_html(report)
    write_text(file, page)
    files = [file]
    if pdf:
        files.append(file.with_suffix(".pdf"))
        with replace_file(files[-1]) as fresh:
            write_pdf(page, fresh, paper)
    if json:
        files.append(file.with_suffix(".json"))
        write_text(files[-1], to_json(report))
    return files
