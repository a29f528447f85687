"""Process that outlives its host and ends what the host leaves: groups of processes, then folders.

It is run as a script, and imports as little as it can, to start quickly. It needs nobody's interpreter lock. Its
standard input is a pipe that only the host can write to: whatever ends the host closes the pipe. Each line of it is a
request: ``group N`` is answered with N and the number of a new group of processes; ``end GROUP``, ``folder PATH`` and
``removed PATH`` have no answer. Paths are bytes in hexadecimal digits. Its argument is the number of the host.
"""

from __future__ import annotations

import os
import signal
import sys

_POSIX = os.name == "posix"
_PERIOD = 0.2  # s between two looks at the host: a fork of it may hold the pipe open
_LONGEST = 10.0  # s for which the removal of folders is tried


class KeeperProcess:
    """The keeper's process: its groups and folders."""

    def __init__(self, host: int):
        self.host = host
        self.groups: set[int] = set()
        self.folders: dict[bytes, None] = {}
        self.life = os.pipe() if _POSIX else None
        """Pipe that only this process can write to, and nobody does: its end is seen by the first of each group."""

    def serve(self) -> None:
        """Answer requests until the host is gone, then end all groups and remove all folders."""
        rest = b""
        while data := self._read():
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                self._answer(*line.decode().split())
        for group in self.groups:
            kill(group)
        remove([*self.folders])

    def _read(self) -> bytes:
        """Wait for requests; return none when the host is gone."""
        if _POSIX:
            import select

            while not select.select([0], [], [], _PERIOD)[0]:
                if os.getppid() != self.host:
                    return b""
        return os.read(0, 1 << 16)

    def _answer(self, request: str, subject: str, of: str = "") -> None:
        if request == "group":
            reply(subject, self._make_group())
        elif request == "end":
            group = int(of)
            self.groups.remove(group)
            kill(group)
            os.waitpid(group, 0)
            reply(subject, group)
        elif request == "folder":
            self.folders[bytes.fromhex(subject)] = None
        elif request == "removed":
            self.folders.pop(bytes.fromhex(subject), None)

    def _make_group(self) -> int:
        """Make a group of processes with a first one that does nothing, and return its number; 0 if that fails.

        Other processes join the group before their programs begin. The first one is not reaped before the group's end:
        until then no other group gets the number, and others can join even if the first one was killed.
        """
        assert self.life is not None
        reading, writing = self.life
        try:
            first = os.fork()
        except OSError:
            return 0
        if first == 0:
            os.setpgid(0, 0)
            os.close(0)
            os.close(writing)
            os.read(reading, 1)  # until the keeper is gone
            os.killpg(0, signal.SIGKILL)
        os.setpgid(first, first)
        self.groups.add(first)
        return first


def reply(number: str, group: int) -> None:
    """Answer a request; nobody reads it where the host has just ended."""
    try:
        os.write(1, f"{number} {group}\n".encode())
    except OSError:
        return


def kill(group: int) -> None:
    """End all processes of a group."""
    try:  # contextlib takes time to import
        os.killpg(group, signal.SIGKILL)
    except OSError:
        return


def remove(folders: list[bytes]) -> None:
    """Remove folders; processes that are just being killed may still write to them."""
    import shutil
    import time

    end = time.monotonic() + _LONGEST
    while (left := [folder for folder in folders if os.path.lexists(folder)]) and time.monotonic() < end:
        for folder in left:
            shutil.rmtree(folder, ignore_errors=True)
        time.sleep(0.01)


def main() -> None:
    """Serve."""
    for name in ("SIGHUP", "SIGINT", "SIGQUIT", "SIGTERM", "SIGTSTP", "SIGUSR1", "SIGUSR2", "SIGBREAK"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)  # somebody may send them to the whole group
    KeeperProcess(int(sys.argv[1])).serve()
    os._exit(0)


if __name__ == "__main__":
    main()
