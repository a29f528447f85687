"""One BLAS thread for many small matrices: a team of threads costs more there than the arithmetic."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from threading import Lock
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

_lock = Lock()  # held by whoever has set the limit, and who alone gives it back


@contextmanager
def one_thread() -> Iterator[None]:
    """Let the BLAS libraries of NumPy and SciPy use one thread inside; what was set before is there again afterwards.

    The limit is one of the whole process: who enters while it is set leaves it alone, nested or in another thread.
    """
    if not _lock.acquire(blocking=False):
        yield
        return
    try:
        import scipy.linalg  # noqa: F401 - it brings a BLAS of its own, which must be loaded to be limited
        from threadpoolctl import threadpool_limits

        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        _lock.release()


def on_one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Run a function inside `one_thread`."""

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with one_thread():
            return function(*args, **kwargs)

    return limited
