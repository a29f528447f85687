"""Templates: pages that escape what they show, and the report's longer texts, kept next to the code that fills them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment, Template

TEXTS = ".txt.j2"
"""Ends of the names of templates with plain text, which is escaped where a page shows it."""


@cache
def environment(package: str) -> Environment:
    """Return the templates of a package, in its folder ``templates``.

    Names that a template asks for and nobody gave are errors. All templates escape but those of plain text.
    """
    import jinja2

    made = jinja2.Environment(
        loader=jinja2.PackageLoader(package),
        undefined=jinja2.StrictUndefined,
        autoescape=lambda name: name is None or not name.endswith(TEXTS),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    made.filters["digits"] = write_digits
    return made


def write_digits(value: float, most: int) -> str:
    """Return a number with so many digits at most; rounding errors, and −0, are 0.

    Examples
    --------
    >>> write_digits(-0.0, 3), write_digits(1.2e-17, 3), write_digits(2 / 3, 3)
    ('0', '0', '0.667')
    """
    return "0" if abs(value) < 1e-15 else f"{value:.{most}g}"


@dataclass(frozen=True)
class Texts:
    """The texts of a section: macros of a template in a package, filled with facts."""

    package: str
    name: str

    def paragraphs(self, macro: str, **facts: Any) -> tuple[str, ...]:
        """Return the paragraphs of a macro, which blank lines part; a line's end is a space, in facts as well."""
        facts = {name: _one_line(fact) if isinstance(fact, str) else fact for name, fact in facts.items()}
        text = str(getattr(self._template().module, macro)(**facts))
        return tuple(part for part in map(_one_line, re.split(r"\n[ \n]*\n", text)) if part)

    def line(self, macro: str, **facts: Any) -> str:
        """Return the one paragraph of a macro; see `paragraphs`."""
        (text,) = self.paragraphs(macro, **facts)
        return text

    def _template(self) -> Template:
        return environment(self.package).get_template(self.name + TEXTS)


def _one_line(text: str) -> str:
    return re.sub(r"[ \n]+", " ", text).strip()
