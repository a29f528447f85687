"""A finished drawing: shown in a notebook, written to a file; the library that draws it as pixels."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from functools import cached_property, partial
from html import escape
from pathlib import Path
from typing import Any

from ...blocks.core import OptionError, accepts, check_file, explain_calls, kinds, write_text
from ..wiring import Structure
from .diagram_picture import WIDTH, DiagramPicture, find_closed
from .live import Facts, live_html

SCALE = 2
"""Pixels of a PNG for each pixel of the drawing."""

ENDINGS = (".svg", ".png", ".pdf", ".html")


PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{title}</title>
<style>html {{ background: #fff }} body {{ margin: 1rem }}
@media (prefers-color-scheme: dark) {{ html {{ background: #14191f; color: #e4e9ee }} }}</style>
{body}</html>
"""
"""A page for the drawing alone."""


@explain_calls
class Drawing:
    """A diagram's drawing; a notebook shows it.

    Attributes
    ----------
    svg : str
        The drawing as SVG.
    size : (float, float)
        Its width and height in pixels.
    title : str
        What it shows, in words.
    """

    def __init__(
        self,
        svg: str,
        size: tuple[float, float] = (0.0, 0.0),
        title: str = "Block diagram",
        live: Callable[[], str] | None = None,
    ):
        self.svg, self.size, self.title = svg, size, title
        self._live = live

    @cached_property
    def html(self) -> str:
        """The drawing as a part of a page, with a few lines of script and no network.

        Subsystems open and close at a click; a block or a wire says what it is; names are searched for.
        """
        return self.svg if self._live is None else self._live()

    def _repr_html_(self) -> str:
        return self.html

    def _repr_svg_(self) -> str:
        return self.svg

    def __repr__(self) -> str:
        width, height = self.size
        return f"<drawing, {width:.0f} × {height:.0f} pixels; .save('diagram.svg') writes it>"

    @accepts(path=kinds.path)
    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the drawing to a file, and return the file.

        Parameters
        ----------
        path : path
            File: ``.svg``; ``.html``, a page on which subsystems open and close; ``.png``, at two pixels for each of
            the drawing, and ``.pdf``, of one page, with the extra ``pdf``.

        Raises
        ------
        OptionError
            If the file has another ending, its folder isn't there, or the extra isn't installed.
        """
        file = Path(path)
        ending = file.suffix.lower()
        if ending not in ENDINGS:
            raise OptionError(
                f"found {str(path)!r}; expected a file for SVG, HTML, PNG or PDF; name it {file.stem}.svg.", port="path"
            )
        check_file(file)
        if ending == ".svg":
            write_text(file, self.svg)
            return file
        if ending == ".html":
            write_text(file, PAGE.format(title=escape(self.title), body=self.html))
            return file
        width, height = self.size
        library = printer(f"a drawing as {ending[1:].upper()}", f"write {file.stem}.svg", "path")
        paper = library.PageSize(0.75 * width, 0.75 * height)  # in points, which are 4/3 pixels
        book = library.Book(paper, library.PAGE_MARGINS_NONE, library.MEDIA_TYPE_PRINT)
        style = f"@page{{size:{width}px {height}px;margin:0}}body{{margin:0}}svg{{display:block}}"
        book.load_html(f"<style>{style}</style>{self.svg}", base_url="file:///drawing.html")
        if ending == ".png":
            book.write_to_png(str(file), width=round(SCALE * width))
        else:
            book.write_to_pdf(str(file))
        return file


@accepts(subsystem=kinds.text, closed=kinds.either(kinds.flag, kinds.names), width=kinds.positive)
def draw(
    table: Structure,
    name: str,
    facts: Facts,
    *,
    subsystem: str = "",
    closed: bool | Iterable[str] | None = None,
    width: float = WIDTH,
) -> Drawing:
    """Return the drawing of a diagram, or of the inside of one of its subsystems.

    Parameters
    ----------
    table : Structure
        The diagram's blocks and wires.
    name : str
        The diagram's name.
    facts : Facts
        What the drawing says of signals.
    subsystem : str
        Path of the subsystem whose inside is drawn; the whole diagram without it.
    closed : bool or list of str, optional
        Subsystems that are drawn closed, all or some; by default all of them in a diagram of more than 40 blocks.
    width : float
        Width in pixels above which chains of blocks are broken into rows.
    """
    shut = find_closed(table, subsystem, closed, diagram=name) - {subsystem}
    page = DiagramPicture(table, shut, width).page(subsystem, subsystem or name)
    live = partial(live_html, table, name, facts, subsystem=subsystem, closed=shut, width=width)
    return Drawing(page.svg, (page.width, page.height), page.about, live)


def printer(wanted: str, instead: str, port: str) -> Any:
    """Return the library; ``wanted`` and ``instead`` say in the error what needs it and what does without."""
    try:
        import plutoprint
    except ImportError as error:
        raise OptionError(
            f'{wanted} needs PlutoPrint, which is not installed. Install it: pip install "loopwright[pdf]"; or '
            f"{instead}.",
            port=port,
        ) from error
    return plutoprint
