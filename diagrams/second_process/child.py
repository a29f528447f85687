"""The second process itself: it is sent a function and keys, and answers with parts of the result."""

from __future__ import annotations

import contextlib
import pickle
from collections.abc import Callable

from ...blocks.core import on_one_thread
from ...fmus.child_processes import Host

Make = Callable[[str, Callable[[str], None]], object]
"""``make(key, notify)``: return the part of a key, the same in any process; ``notify`` gets texts on progress."""


@on_one_thread
def main() -> None:
    """Answer keys with parts until the host ends: ``("progress", text)``, then ``("made", bytes)``."""
    with contextlib.suppress(EOFError, BrokenPipeError):
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
