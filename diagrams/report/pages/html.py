"""A report as one HTML page with its styles and figures, without a network; only a drawing has a script."""

from __future__ import annotations

import re
from functools import cache
from typing import TYPE_CHECKING

from .document import Document
from .page import Page
from .printed_values import with_power
from .templating import environment

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

PAGE = "page.html.j2"

_LONG_WORD = re.compile(r"\b[0-9a-f]{32,}\b|(?<![<&])[\w./\\-]{40,}")
_SYMBOL = re.compile(r"(?<![\w.])([MTFbkm])_([stcdemk])(?![\w.]*\w)")
"""Symbols with an index, such as M_s and b_e; parts of dotted paths and of longer names are none."""
_EXPONENT = re.compile(r"(?<![\w.])(-?\d+(?:\.\d+)?)e([-+]?\d+)(?![\w.]*\w)")
_MINUS = re.compile(r"(?<![\w.)&;])-(?=[\d∞])")
"""Numbers as a program writes them: 1e-09, -1.5."""
_PIECES = re.compile(r"[^/\\._-]{1,16}[/\\._-]?|[/\\._-]")
"""Words that are too long for a column, such as digests and paths of files, and where they may break."""


def to_html(report: Document) -> str:
    """Return the page.

    Every number in a table leads to its line in the appendix: dotted path, tolerance, how it was confirmed, and from
    there to its definition.
    """
    return _environment().get_template(PAGE).render(page=Page.of(report))


@cache
def _environment() -> Environment:
    made = environment(__package__)
    made.filters |= {"marked": marked, "broken": broken, "breakable": breakable}
    return made


def marked(text: str) -> Markup:
    """Escape a text; what is between backticks is code; numbers and symbols such as M_s are as in print."""
    from markupsafe import Markup, escape

    parts = re.split(r"`([^`]+)`", str(escape(text)))
    return Markup("".join(f"<code>{part}</code>" if i % 2 else _printed(part) for i, part in enumerate(parts)))


def _printed(text: str) -> str:
    """Return a text with its numbers and symbols in print: 1×10⁻⁹, −1.5, b_e with its index below the line."""
    text = _EXPONENT.sub(lambda number: with_power(number[1], number[2]), text)
    return _MINUS.sub("−", _SYMBOL.sub(r"\1<sub>\2</sub>", text))


def broken(text: str) -> Markup:
    """Escape a text as `marked` does; its long words may break."""
    from markupsafe import Markup

    return Markup(_LONG_WORD.sub(lambda word: "<wbr>".join(_PIECES.findall(word[0])), str(marked(text))))


def breakable(path: str) -> Markup:
    """Escape a dotted path, which may break behind its dots and underscores."""
    from markupsafe import Markup, escape

    return Markup(str(escape(path)).replace(".", ".<wbr>").replace("_", "_<wbr>"))
