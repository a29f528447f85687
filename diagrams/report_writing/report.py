"""A report, which a notebook shows as a page."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

from ...blocks.core import explain_calls
from .html import to_html
from .model import Document


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
    """

    def _repr_html_(self) -> str:
        """Show it in a notebook, in an inner page of its own: its styles are meant for a whole page."""
        page = escape(to_html(self), quote=True)
        return f'<iframe srcdoc="{page}" style="width:100%;height:45em;border:1px solid #d5dbe1"></iframe>'
