"""Makers of what is exported of objects that this package doesn't know, such as diagrams; it imports nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Maker = Callable[..., Any]
"""Returns what is exported of an object, a `LoopSpec`; None for an object of another kind."""

_MAKERS: list[Maker] = []


def register_maker(maker: Maker) -> None:
    """Let `loopwright.fmus.build` ask a maker for what is exported of an object."""
    _MAKERS.append(maker)


def make_exported(model: object, **options: Any) -> Any:
    """Return what is exported of an object, by the first maker that knows its kind; None if none does."""
    return next((found for maker in _MAKERS if (found := maker(model, **options)) is not None), None)
