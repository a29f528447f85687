"""Code that is compiled while a run is interpreted."""

from __future__ import annotations

import os
from collections.abc import Callable
from threading import Thread
from typing import Any

from ...blocks.core import LoopwrightError
from ..flat import FlatDiagram
from .diagram_code import DiagramCode, Sources

_WRITING = 3e-5  # s to write the C code of an operation
_COMPILING = 1e-3  # s to compile it
_SHARE = 0.2  # of the time that a run still takes, at most, for writing code
_LEAST = 0.1  # s that a run still takes at least, for code that is in the cache; with a compiler ten times as much


class BackgroundCode:
    """C code of a diagram's functions, made while they are interpreted, as soon as the run is long enough for it.

    A run that is short never waits, and starts no compiler. The compiler is its own process.
    """

    def __init__(
        self,
        flat: FlatDiagram,
        write: Callable[[], Sources],
        prepare: Callable[[], Any] = lambda: None,
    ):
        self._flat, self._write, self._prepare = flat.origin, write, prepare  # other numbers change no code
        self._sources: Sources | None = None
        self._thread: Thread | None = None
        self._over = False
        self.ready = False
        self.code: DiagramCode | None = (
            None  # none before, and where it can't replace interpreted ticks to the last bit
        )
        self.failure: Exception | None = None  # no compiler, one that fails, or a cache that does

    def look(self, spent: float, rest: float) -> None:
        """Begin to make the code where it pays; ticks have taken ``spent`` s, and the rest may take ``rest`` s.

        A run that has taken long is taken to continue for as long.
        """
        if self._over:
            return
        rest = max(spent, rest)
        if self._sources is None:
            if rest < max(_LEAST, _WRITING * self._flat.operations / _SHARE):
                return
            try:
                self._sources = self._write()
            except LoopwrightError as error:
                self._end(error)
                return
            if not self._sources.exact:
                self._end()
                return
        try:
            cached = self._sources.is_compiled()
        except (LoopwrightError, OSError) as error:
            self._end(error)
            return
        compiling = _COMPILING * min(self._flat.operations, self._sources.operations)
        crowded = 1.0 if (os.cpu_count() or 1) > 1 else 4.0  # the compiler takes time from the run itself
        if cached:
            self._load(self._sources)
        elif rest > crowded * (10 * _LEAST + compiling):
            self._over = True
            self._thread = Thread(target=self._load, args=(self._sources,), name="loopwright-compiler", daemon=True)
            self._thread.start()

    def wait(self) -> None:
        """Wait until a compiler that runs has ended."""
        if self._thread is not None:
            self._thread.join()

    def _load(self, sources: Sources) -> None:
        try:
            self._prepare()
            self.code = sources.load()
        except (LoopwrightError, OSError) as error:  # the cache's folder may be gone, or hold what can't be loaded
            self._end(error)
            return
        self._over = self.ready = True

    def _end(self, error: Exception | None = None) -> None:
        self._over, self.failure = True, error
