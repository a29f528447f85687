"""Garbage collection waits while a diagram is built: tens of thousands of new values are kept, and none is garbage."""

from __future__ import annotations

import gc
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


def without_collection(function: Callable[P, R]) -> Callable[P, R]:
    """Run a function without cyclic garbage collection, and continue with it after, if it was on."""
    # The collector would look at all values again and again while they grow: a third of the time for 10,000 blocks.
    # Reference counts continue. Several threads may do so at once: whoever has turned it off turns it on again.

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        if not gc.isenabled():
            return function(*args, **kwargs)
        gc.disable()
        try:
            return function(*args, **kwargs)
        finally:
            gc.enable()

    return run
