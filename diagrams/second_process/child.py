"""The second process itself: it reads a function from its standard input, and answers with parts of the result."""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import sys
from collections.abc import Callable

from ...blocks.core import on_one_thread
from ..sweeps import receive, send

Make = Callable[[str, Callable[[str], None]], object]
"""``make(key, tell)``: return the part of a key, the same in any process; ``tell`` gets what is being done, as text."""


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
        make: Make | None = None
        while True:
            key = receive(orders)
            try:
                make = pickle.loads(data) if make is None else make
                made = pickle.dumps(make(key, lambda text: send(answers, ("told", text))), protocol=5)
            except BrokenPipeError:
                return
            except Exception:
                send(answers, ("failed", None))
            else:
                send(answers, ("made", made))
