"""A second process and the side of the first: parts of a result are shared out as both processes get to them.

The second process is sent a function and keys (`main`), and answers with parts of the result.
"""

from __future__ import annotations

import pickle
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Generic, TypeVar

from ...blocks.core import LoopwrightError, on_one_thread
from ...fmus.child_processes import Host, ProcessGroup, PythonChild
from ..sweeps import to_bytes

T = TypeVar("T")
PAUSE = 0.1
"""Seconds between two looks at what the second process reports, while this one waits for it."""
Make = Callable[[str, Callable[[str], None]], object]
"""``make(key, notify)``: return the part of a key, the same in any process; ``notify`` gets texts on progress."""


class SecondProcess(Generic[T]):
    """A process that makes parts of a result; use it in a ``with`` statement, whose end is its end."""

    # Every part is the same, whichever process makes it. A part that the second process can't make or send, or on which
    # it ends, is made here.

    def __init__(self, make: Make, name: str):
        self._child: PythonChild | None = None
        self._texts: SimpleQueue[str] = SimpleQueue()
        self._lock, self._over = threading.Lock(), False
        self._made: dict[str, bytes] = {}
        self._left: deque[str] = deque()
        self._thread: threading.Thread | None = None
        try:
            data = to_bytes(make, name)
            self._group = ProcessGroup()
            try:
                self._child = PythonChild(self._group, "loopwright.diagrams.second_process.process")
            except BaseException:
                self._group.end()
                raise
        except (LoopwrightError, OSError):  # such as a class of the main script: everything is made here
            return
        with suppress(OSError):  # it has ended: then everything is made here, too
            self._child.send(data)

    def __enter__(self) -> SecondProcess[T]:
        return self

    def __exit__(self, *exc: object) -> None:
        self._over = True
        if self._child is None:
            return
        self._child.kill()
        self._group.end()
        if self._thread is not None:
            self._thread.join()
        self._child.wait()

    def share(self, keys: Sequence[str], make: Callable[[str], T], report: Callable[[str], None]) -> list[T]:
        """Return the parts of all keys: from the first one on made here, from the last one on in the second process."""
        self._left = deque(keys[1:])
        if self._child is not None:
            self._thread = threading.Thread(target=self._go, args=[self._child], daemon=True)
            self._thread.start()
        found: dict[str, T] = {}
        key = keys[0] if keys else None
        while key is not None:
            self._pass_on(report)
            found[key] = make(key)
            key = self._take(first=True)
        while self._thread is not None and self._thread.is_alive():
            self._thread.join(PAUSE)
            self._pass_on(report)
        self._pass_on(report)
        for key in keys:
            if key not in found:  # in their order, so that the first error is that of one process alone
                found[key] = pickle.loads(self._made.pop(key)) if key in self._made else make(key)
        return [found[key] for key in keys]

    def _pass_on(self, report: Callable[[str], None]) -> None:
        with suppress(Empty):
            while True:
                report(self._texts.get_nowait())

    def _take(self, *, first: bool) -> str | None:
        with self._lock:
            if not self._left or self._over:
                return None
            return self._left.popleft() if first else self._left.pop()

    def _go(self, child: PythonChild) -> None:
        """Give the second process one key after the other, and keep its answers."""
        with suppress(EOFError, OSError):
            while (key := self._take(first=False)) is not None:
                child.send(key)
                kind, answer = child.receive()
                while kind == "progress":
                    self._texts.put(answer)
                    kind, answer = child.receive()
                if kind == "made":
                    self._made[key] = answer


@on_one_thread
def main() -> None:
    """Answer keys with parts until the host ends: ``("progress", text)``, then ``("made", bytes)``."""
    with suppress(EOFError, BrokenPipeError):
        host = Host()
        data = host.receive()
        make: Make | None = None
        while True:
            key = host.receive()
            try:
                make = pickle.loads(data) if make is None else make
                made = pickle.dumps(make(key, lambda text: host.send(("progress", text))), protocol=5)
            except BrokenPipeError:
                return
            except Exception:  # it fails, or can't be sent: the first process makes it, and raises its error
                host.send(("failed", None))
            else:
                host.send(("made", made))
