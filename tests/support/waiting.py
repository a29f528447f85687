"""Waiting for a fact: an event, a file, a process that has ended. The limit is far, so that no load reaches it."""

import os
import signal
import threading
import time
from pathlib import Path

FAR = 300.0
"""Seconds that only a mistake takes."""


def wait_for(look, wanted=True, seconds=FAR):
    """Return what is found, as soon as it is the wanted, or in the end."""
    end = time.monotonic() + seconds
    while (found := look()) != wanted and time.monotonic() < end:
        time.sleep(0.01)
    return found


def is_there(pid):
    """Return whether a process has not ended; a zombie has."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


class Interruption:
    """Sends this process a SIGINT as soon as something has happened, from a thread; use it in a ``with`` statement.

    Parameters
    ----------
    happened : callable
        Whether it has. The thread asks again and again.
    """

    def __init__(self, happened):
        self._happened, self._over = happened, threading.Event()
        self._thread = threading.Thread(target=self._go)

    def _go(self):
        while not self._over.wait(0.01):
            if self._happened():
                os.kill(os.getpid(), signal.SIGINT)
                return

    def __enter__(self):
        self._before = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in background processes
        self._thread.start()
        return self

    def __exit__(self, *exc):
        self._over.set()
        self._thread.join()
        signal.signal(signal.SIGINT, self._before)


class Meeting:
    """A file in which calls of the zoo's FMUs count themselves: faults "count", "slow", "deaf_hang", and "meet".

    A call that meets waits for the other one of its pair, and fails after a minute.
    """

    def __init__(self, folder, monkeypatch):
        self.file = folder / "meeting"
        self.file.write_bytes(bytes(8))
        monkeypatch.setenv("ZOO_MEETING", str(self.file))

    @property
    def count(self):
        """Number of calls that have come."""
        return int.from_bytes(self.file.read_bytes()[:4], "little")
