"""Templates of C text, in ``templates/``: the text with ``${name}`` for what changes, and lines in ``{% for … %}``."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment


@cache
def _environment() -> Environment:
    import jinja2

    return jinja2.Environment(
        loader=jinja2.PackageLoader(__package__),
        undefined=jinja2.StrictUndefined,
        variable_start_string="${",  # C is full of double braces, and has no dollar
        variable_end_string="}",
        autoescape=False,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def fill_template(template: str, **facts: Any) -> str:
    """Return the text of a template, filled with facts; a fact that is missing is an error."""
    return _environment().get_template(f"{template}.j2").render(facts)
