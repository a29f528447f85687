"""Interrupts (Ctrl-C) that come while C runs, and that ctypes would drop as C calls Python."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_CTRL_C = int(signal.SIGINT)
_below: Any = sys.modules.get("_signal", signal)  # `signal` wraps it with enums, which take nine tenths of its time
_find, _handle = _below.getsignal, _below.signal


class Interrupts(threading.local):
    """Keeps an interrupt (Ctrl-C) that comes while C runs, until Python is where it can be raised.

    Python raises it at its next instruction: the first one of a function that C calls, where ctypes would drop it.
    """

    def __init__(self) -> None:
        self.heard = False  # True while Python, called by C, catches an interrupt: it is raised at once
        self.came = False  # True while one waits to be raised

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Keep an interrupt of this block for its end, but where it is heard."""
        main = threading.current_thread() is threading.main_thread()
        if not main or _find(_CTRL_C) is not signal.default_int_handler:
            yield
            self.check()
            return
        self.heard = self.came = False
        _handle(_CTRL_C, self._note)
        try:
            yield
        finally:
            _handle(_CTRL_C, signal.default_int_handler)
        self.check()

    def check(self) -> None:
        """Raise the interrupt that waits."""
        if self.came:
            self.came = False
            raise KeyboardInterrupt

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.heard:
            signal.default_int_handler(number, frame)
        self.came = True


INTERRUPTS = Interrupts()
"""Those of this process; only its main thread has any."""
