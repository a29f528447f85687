"""The way to every instance of an FMU."""

from __future__ import annotations

from typing import Any, TypeVar

from ..calls import LoadedFmu

L = TypeVar("L", bound=LoadedFmu)


def open_fmu(kind: type[L], *arguments: Any, **options: Any) -> L:
    """Load an FMU and make an instance of it; all that loads an FMU comes here.

    Parameters
    ----------
    kind : type
        `LoadedFmu` or a class of it, which takes ``make_calls``.
    *arguments, **options
        Arguments of the class; the first one is the block.
    """
    return kind(*arguments, **options)
