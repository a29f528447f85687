"""A finished drawing: shown in a notebook, written to a file."""

from __future__ import annotations

import os
import re
from pathlib import Path

from ...blocks.core import OptionError, accepts, check_file, explain_calls, kinds, write_text
from .printer import printer

SCALE = 2
"""Pixels of a PNG for each pixel of the drawing."""

ENDINGS = (".svg", ".png", ".pdf")


@explain_calls
class Drawing:
    """A diagram's drawing; a notebook shows it.

    Attributes
    ----------
    svg : str
        The drawing as SVG.
    """

    def __init__(self, svg: str):
        self.svg = svg

    def _repr_svg_(self) -> str:
        return self.svg

    def __repr__(self) -> str:
        width, height = self.size
        return f"<drawing, {width:.0f} × {height:.0f} pixels; .save('diagram.svg') writes it>"

    @property
    def size(self) -> tuple[float, float]:
        """Width and height in pixels."""
        found = re.search(r'width="([\d.]+)" height="([\d.]+)"', self.svg)
        return (float(found[1]), float(found[2])) if found else (0.0, 0.0)

    @accepts(path=kinds.path)
    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the drawing to a file, and return the file.

        Parameters
        ----------
        path : path
            File: ``.svg``; ``.png``, at two pixels for each of the drawing; ``.pdf``, of one page. The last two need
            the extra ``pdf``.

        Raises
        ------
        OptionError
            If the file has another ending, its folder isn't there, or the extra isn't installed.
        """
        file = Path(path)
        ending = file.suffix.lower()
        if ending not in ENDINGS:
            raise OptionError(
                f"found {str(path)!r}; expected a file for SVG, PNG or PDF; name it {file.stem}.svg.", port="path"
            )
        check_file(file)
        if ending == ".svg":
            write_text(file, self.svg)
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
