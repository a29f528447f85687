"""Docstrings for Sphinx: bars of absolute values, and attributes whose sentence has a colon."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphinx.application import Sphinx

_BAR = re.compile(r"(``.*?``)|\|(?=[^\s|][^|]*\|)")


def escaped(line: str) -> str:
    """Return a line in which |x| is no substitution of reStructuredText."""
    return _BAR.sub(lambda match: match[1] or "\\|", line)


def _prepare(app: Sphinx, what: str, name: str, made: Any, options: Any, lines: list[str]) -> None:
    """Change the lines of a docstring before napoleon reads them."""
    code = False
    for i, line in enumerate(lines):
        indented = not line.strip() or line.startswith(" ")
        code = (code and indented) or (i > 0 and lines[i - 1].rstrip().endswith("::"))
        if not code and not line.lstrip().startswith((">>>", "...")):
            lines[i] = escaped(line)
    if what in ("attribute", "property", "data"):
        lines.insert(0, "")  # else napoleon takes what is before the first colon for a type


def setup(app: Sphinx) -> dict[str, Any]:
    """Run ahead of napoleon."""
    app.connect("autodoc-process-docstring", _prepare, priority=100)
    return {"parallel_read_safe": True}
