"""Functions of Python that C calls."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

from ...blocks.interrupts import INTERRUPTS


class CalledBack:
    """Functions of Python that C calls; an error of one, or an interrupt, waits until C has returned.

    Attributes
    ----------
    error : BaseException or None
        The first error since the last `check`.
    """

    def __init__(self) -> None:
        self.error: BaseException | None = None
        self._kept: list[Any] = []

    def function(self, kind: Any, call: Callable[..., int | None], failed: int = 0) -> int:
        """Return the address of a function for C, which lives as long as this; ``failed`` is its result at an error."""

        def guarded(*arguments: Any) -> int:
            try:
                INTERRUPTS.heard = True
                INTERRUPTS.check()
                return call(*arguments) or 0
            except BaseException as error:
                self.error = self.error or error
                return failed
            finally:
                INTERRUPTS.heard = False

        self._kept.append(kind(guarded))
        address = ctypes.cast(self._kept[-1], ctypes.c_void_p).value
        assert address is not None
        return address

    def check(self) -> None:
        """Raise the error that waits."""
        error, self.error = self.error, None
        if error is not None:
            raise error


CALL = ctypes.CFUNCTYPE(ctypes.c_int)
"""Kind of a function without arguments whose result is an integer."""
TICK = ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 4, ctypes.c_int)
"""Kind of the function of a tick."""
