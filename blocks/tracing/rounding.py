"""Numbers that record when they are rounded to even, since a trace rounds differently."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np

_noticed: ContextVar[list[str] | None] = ContextVar("loopwright_rounding", default=None)


@contextmanager
def record_rounding() -> Iterator[list[str]]:
    """Collect the names of rounding functions that are applied to watched numbers within the context."""
    found: list[str] = []
    token = _noticed.set(found)
    try:
        yield found
    finally:
        _noticed.reset(token)


class Watched(np.ndarray):
    """An array that is watched; so is everything that is computed from it."""

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        found = _noticed.get()
        if found is not None and ufunc is np.rint:  # np.round and np.around call it
            found.append(ufunc.__name__)
        if kwargs.get("out") is not None:
            kwargs["out"] = tuple(_unwatch(v) for v in kwargs["out"])
        return watch(getattr(ufunc, method)(*map(_unwatch, inputs), **kwargs))

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return watch(super().__array_function__(func, types, args, kwargs))

    def __getitem__(self, key: Any) -> Any:
        return watch(np.asarray(self)[key])

    def __iter__(self) -> Iterator[Any]:
        return (self[i] for i in range(len(self)))


def _unwatch(value: Any) -> Any:
    return np.asarray(value) if isinstance(value, Watched) else value


def watch(value: Any) -> Any:
    """Return numbers as a `Watched` array, anything else as it is."""
    if type(value) in (tuple, list):
        return type(value)(map(watch, value))
    return np.asarray(value).view(Watched) if isinstance(value, np.ndarray | np.number | np.bool_ | float) else value
