"""Processes that a host and its children have started, found in /proc by a mark in their environment."""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from uuid import uuid4

import pytest

from support.waiting import FAR, is_there, wait_for

ON_LINUX = pytest.mark.skipif(sys.platform != "linux", reason="looks at /proc")
MARK = "LOOPWRIGHT_TEST_MARK"
GONE = 20.0
"""Seconds in which all processes must be gone; what they do takes far longer."""


def marked(mark):
    """Return the command lines of all processes with a mark, by number."""
    found, wanted = {}, f"{MARK}={mark}".encode()
    for place in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if wanted in (place / "environ").read_bytes().split(b"\0") and is_there(place.name):
                found[int(place.name)] = (place / "cmdline").read_bytes().replace(b"\0", b" ").decode()
    return found


def seconds_of(pid):
    """Return the processor time that a process has taken in user mode, in s; 0 if there is none."""
    with suppress(OSError):
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11]) / os.sysconf("SC_CLK_TCK")
    return 0.0


class Host:
    """A Python process with a mark, that all its descendants have; none is left after the ``with`` statement.

    Parameters
    ----------
    script : str
        What it runs.
    *arguments : str
        Its arguments.
    **environment
        More of its environment.
    """

    def __init__(self, script, *arguments, **environment):
        self.mark = uuid4().hex
        self.process = subprocess.Popen(
            [sys.executable, "-c", script, *arguments],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **environment, MARK: self.mark},
        )

    def others(self):
        """Return the command lines of its descendants, by number."""
        return {pid: line for pid, line in marked(self.mark).items() if pid != self.process.pid}

    def kill(self, number):
        """Send it a signal, and return what is left of its descendants in the end."""
        self.process.send_signal(number)
        assert self.process.wait(FAR) == -number
        return wait_for(self.others, {}, GONE)

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.process.kill()
        self.process.wait()
        while left := self.others():
            for pid in left:
                with suppress(OSError):
                    os.kill(pid, signal.SIGKILL)
        self.process.stdout.close()
