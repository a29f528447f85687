"""The second process itself: it reads a task from its standard input, and answers with parts of the result."""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import sys
from collections.abc import Callable
from typing import Protocol

from ...blocks.core import on_one_thread
from ..sweeps import receive, send


class Task(Protocol):
    """Makes parts of a result, each by its key, in any process alike."""

    def make(self, key: str, tell: Callable[[str], None]) -> object:
        """Return the part of a key; ``tell`` is told what is being done."""


@on_one_thread
def main() -> None:
    """Answer keys with parts until the standard input ends: ``("told", text)``, then ``("made", bytes)``.

    A part that fails, or can't be sent, is answered with ``("failed", None)``: the first process makes it itself, and
    tells its error. What anybody prints goes to the standard error.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that has started it ends it
    if hasattr(signal, "SIGTTOU"):  # it is no foreground process, and may write to any terminal all the same
        signal.signal(signal.SIGTTOU, signal.SIG_IGN)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    orders = sys.stdin.buffer
    with contextlib.suppress(EOFError, BrokenPipeError):
        sys.path[:] = receive(orders)
        data = receive(orders)
        task: Task | None = None
        while True:
            key = receive(orders)
            try:
                task = pickle.loads(data) if task is None else task
                made = pickle.dumps(task.make(key, lambda text: send(answers, ("told", text))), protocol=5)
            except BrokenPipeError:
                return
            except Exception:
                send(answers, ("failed", None))
            else:
                send(answers, ("made", made))
