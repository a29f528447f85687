"""Numbers that notice when they are rounded to even, which a trace does otherwise."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np

_noticed: ContextVar[list[str] | None] = ContextVar("loopwright_rounding", default=None)


@contextmanager
def watching() -> Iterator[list[str]]:
    """Collect the names of the rounding functions that are applied to watched numbers inside."""
    found: list[str] = []
    token = _noticed.set(found)
    try:
        yield found
    finally:
        _noticed.reset(token)


class Watched(np.ndarray):
    """An array that hands its being watched on to whatever is computed from it."""

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        found = _noticed.get()
        if found is not None and ufunc is np.rint:  # np.round and np.around end here too
            found.append(ufunc.__name__)
        if kwargs.get("out") is not None:
            kwargs["out"] = tuple(_bare(v) for v in kwargs["out"])
        return watched(getattr(ufunc, method)(*map(_bare, inputs), **kwargs))

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return watched(super().__array_function__(func, types, args, kwargs))

    def __getitem__(self, key: Any) -> Any:
        return watched(np.asarray(self)[key])

    def __iter__(self) -> Iterator[Any]:
        return (self[i] for i in range(len(self)))


def _bare(value: Any) -> Any:
    return np.asarray(value) if isinstance(value, Watched) else value


def watched(value: Any) -> Any:
    """Return numbers as watched ones, anything else as it is."""
    if type(value) in (tuple, list):
        return type(value)(map(watched, value))
    return np.asarray(value).view(Watched) if isinstance(value, np.ndarray | np.number | np.bool_ | float) else value
