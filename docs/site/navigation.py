"""The tree of pages at the left: made once for all pages of a folder that are not in it, most of the reference."""

from __future__ import annotations

import posixpath
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphinx.application import Sphinx


def _share(app: Sphinx, page: str, template: str, context: dict[str, Any], tree: Any) -> None:
    """Let the theme's call for the tree return that of an earlier page where it is the same."""
    if "orphan" not in app.env.metadata.get(page, {}) or "toctree" not in context:
        return
    make = context["toctree"]
    made: dict[Any, str] = app.builder.__dict__.setdefault("loopwright_trees", {})

    def toctree(**options: Any) -> str:
        key = (posixpath.dirname(page), *sorted(options.items()))
        if key not in made:
            made[key] = make(**options)
        return made[key]

    context["toctree"] = toctree


def setup(app: Sphinx) -> dict[str, Any]:
    """Run ahead of the theme."""
    app.connect("html-page-context", _share, priority=100)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
