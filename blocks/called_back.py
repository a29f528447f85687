"""Functions of Python that C calls."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

from .interrupts import INTERRUPTS


class CalledBack:
    """Functions of Python that C calls; an error of one, or an interrupt, waits until C has returned."""

    def __init__(self) -> None:
        self._error: BaseException | None = None
        self._kept: list[Any] = []

    def function(
        self,
        kind: Any,
        call: Callable[..., int | None],
        failed: int = 0,
        *,
        interrupted: Callable[..., None] | None = None,
    ) -> int:
        """Return the address of ``call`` for C, a function of ctypes' ``kind``, which lives as long as this object.

        A result of None is 0, and that of a failed call is ``failed``. Where an interrupt has come before,
        ``interrupted`` is called in its place.
        """

        def guarded(*arguments: Any) -> int:
            try:
                INTERRUPTS.heard = True
                if interrupted is not None and INTERRUPTS.came:
                    interrupted(*arguments)
                INTERRUPTS.check()
                return call(*arguments) or 0
            except BaseException as error:
                self._error = self._error or error
                return failed
            finally:
                INTERRUPTS.heard = False

        self._kept.append(kind(guarded))
        address = ctypes.cast(self._kept[-1], ctypes.c_void_p).value
        assert address is not None
        return address

    def take_error(self) -> BaseException | None:
        """Return the first error that waits, and forget it; None without any."""
        error, self._error = self._error, None
        return error

    def check(self) -> None:
        """Raise the error that waits."""
        error = self.take_error()
        if error is not None:
            raise error
