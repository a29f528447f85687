"""Leader of a group of child processes: it ends the group as soon as the process that has started it is gone.

A process of its own needs nobody's interpreter lock. Its standard input is a pipe that only the starting process can
write to, and nobody does: whatever ends that process closes the pipe. Its arguments are the number of that process,
and folders to remove in that case. It is run as a script, and imports the standard library only, to start quickly.
"""

from __future__ import annotations

import os
import select
import signal
import sys

_PERIOD = 0.2  # s between two looks at the parent: a fork of it may hold the pipe open
_LONGEST = 10.0  # s for which the removal of folders is tried


def main() -> None:
    """Wait until the parent is gone, then end the group, and remove the folders."""
    parent, folders = int(sys.argv[1]), sys.argv[2:]
    for name in ("SIGHUP", "SIGINT", "SIGQUIT", "SIGTERM", "SIGTSTP", "SIGUSR1", "SIGUSR2"):
        signal.signal(getattr(signal, name), signal.SIG_IGN)  # somebody may send them to the whole group
    while os.getppid() == parent and not select.select([0], [], [], _PERIOD)[0]:
        pass
    if folders:
        try:
            if (child := os.fork()) == 0:
                remove(folders)
                os._exit(0)
            os.setpgid(child, child)  # it outlives the group
        except OSError:  # there is no room for one more process
            pass
    os.killpg(os.getpid(), signal.SIGKILL)


def remove(folders: list[str]) -> None:
    """Remove folders; processes that are just being killed may still write to them."""
    import shutil
    import time

    end = time.monotonic() + _LONGEST
    while (left := [folder for folder in folders if os.path.lexists(folder)]) and time.monotonic() < end:
        for folder in left:
            shutil.rmtree(folder, ignore_errors=True)
        time.sleep(0.01)


if __name__ == "__main__":
    main()
