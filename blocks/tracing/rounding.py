"""Numbers that record when they are rounded to even, since a trace rounds differently."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np

from .traced_functions import NotTracedError

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

    def __array_ufunc__(self, ufunc: Any, method: Any, *inputs: Any, **kwargs: Any) -> Any:
        found = _noticed.get()
        if found is not None and ufunc is np.rint:  # np.round and np.around call it
            found.append(ufunc.__name__)
        # All are plain arrays now, also in where=, and the method of a plain array asks no operand: nothing comes back.
        plain, options = _unwatch(inputs), _unwatch(kwargs)
        made = super().__array_ufunc__(ufunc, method, *plain, **options)
        if made is NotImplemented and not any(_is_foreign(v) for v in plain):  # else the operand of that class is asked
            raise NotTracedError(
                f"NumPy {np.__version__} hands np.{ufunc.__name__} back. Write it in sums, products and np.where"
            )
        return watch(made)

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        return watch(super().__array_function__(func, types, args, kwargs))

    def __getitem__(self, key: Any) -> Any:
        return watch(np.asarray(self)[key])

    def __iter__(self) -> Iterator[Any]:
        return (self[i] for i in range(len(self)))


def _unwatch(value: Any) -> Any:
    """Return NumPy's own arrays for watched ones, also in tuples, lists and dictionaries."""
    if isinstance(value, Watched):
        return value.view(np.ndarray)
    if type(value) in (tuple, list):
        return type(value)(map(_unwatch, value))
    return {k: _unwatch(v) for k, v in value.items()} if type(value) is dict else value


def _is_foreign(value: Any) -> bool:
    """Whether a value's class computes NumPy's functions itself."""
    return not isinstance(value, np.ndarray | np.generic) and hasattr(value, "__array_ufunc__")


def watch(value: Any) -> Any:
    """Return numbers as a `Watched` array, anything else as it is."""
    if type(value) in (tuple, list):
        return type(value)(map(watch, value))
    return np.asarray(value).view(Watched) if isinstance(value, np.ndarray | np.number | np.bool_ | float) else value
