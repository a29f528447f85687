"""The second process itself: it is sent a function and keys, and answers with parts of the result."""

from __future__ import annotations

import contextlib
import pickle
from collections.abc import Callable

from ...blocks.core import on_one_thread
from ...fmus.child_processes import Host

Make = Callable[[str, Callable[[str], None]], object]
"""``make(key, tell)``: return the part of a key, the same in any process; ``tell`` gets what is being done, as text."""


@on_one_thread
def main() -> None:
    """Answer keys with parts until the host ends: ``("told", text)``, then ``("made", bytes)``.

    A part that fails, or can't be sent, is answered with ``("failed", None)``: the first process makes it itself, and
    tells its error.
    """
    with contextlib.suppress(EOFError, BrokenPipeError):
        host = Host()
        data = host.receive()
        make: Make | None = None
        while True:
            key = host.receive()
            try:
                make = pickle.loads(data) if make is None else make
                made = pickle.dumps(make(key, lambda text: host.send(("told", text))), protocol=5)
            except BrokenPipeError:
                return
            except Exception:
                host.send(("failed", None))
            else:
                host.send(("made", made))
