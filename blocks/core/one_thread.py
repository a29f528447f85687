"""One BLAS thread for many small matrices: several threads cost more there than the arithmetic."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from threading import Lock
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

_lock = Lock()  # held by the caller that has set the limit; only that one restores it


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit the BLAS libraries of NumPy and SciPy to one thread inside the ``with`` block, and restore them."""
    # the limit is the whole process's: a caller that enters while it is set, nested or in another thread, leaves it
    if not _lock.acquire(blocking=False):
        yield
        return
    try:
        with _find_blas().limit(limits=1):
            yield
    finally:
        _lock.release()


@cache
def _find_blas() -> Any:
    """Return the BLAS libraries of NumPy and SciPy; to look for them takes milliseconds, so it is done once."""
    import scipy.linalg  # noqa: F401 - brings its own BLAS, which must be loaded to be limited
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas")


def on_one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Run a function inside `one_thread`."""

    @wraps(function)
    def run_limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with one_thread():
            return function(*args, **kwargs)

    return run_limited
