"""Groups of child processes, which end with this process, however it ends.

A worker or a compiler does not notice that its parent has been killed while it computes, and a thread that looks for it
needs the interpreter lock, which others may hold. So each group has a leader, a small process that does nothing else
(`leader`), and the group ends by a signal that no process can refuse. FMUs in processes of their own have groups of
their own and look for their parent themselves: see `isolation`.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

_LEADER = str(Path(__file__).with_name("leader.py"))
_POSIX = os.name == "posix"


class ProcessGroup:
    """Child processes that end with this process, or with `end`, and with them all processes that they start.

    The leader is there before any other process of the group, and a process is in the group before its program begins:
    at no moment could one be left behind. On Windows, which has no such groups, processes are only started.

    Parameters
    ----------
    *folders : Path
        Folders of the group, which are removed if this process ends before `end`.

    Raises
    ------
    OSError
        If its leader can't be started.
    """

    def __init__(self, *folders: Path):
        self._home, self._folders = os.getpid(), [os.path.abspath(folder) for folder in folders]
        self._killed: list[subprocess.Popen[bytes]] = []  # leaders that somebody else has ended
        self._leader = self._start_leader() if _POSIX else None

    def _start_leader(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-I", "-S", _LEADER, str(self._home), *self._folders],
            cwd="/",  # the present one may be removed
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            process_group=0,
        )

    def start(self, command: Sequence[str], **options: Any) -> subprocess.Popen[Any]:
        """Start a process in the group; ``options`` are those of `subprocess.Popen`.

        Raises
        ------
        OSError
            If it can't be started, or the group has ended.
        """
        if _POSIX:
            if self._leader is None:
                raise ProcessLookupError("its group of processes has ended")
            if _has_ended(self._leader):  # a process that ends its own group ends the leader, too
                self._killed.append(self._leader)
                self._leader = self._start_leader()
            options["process_group"] = self._leader.pid
        return subprocess.Popen(command, **options)

    def kill(self) -> None:
        """End all processes of the group; its leader is not reaped, so that the group keeps its number until `end`."""
        if self._leader is not None and os.getpid() == self._home:  # a fork of this process leaves the group alone
            for leader in (*self._killed, self._leader):
                with suppress(OSError):
                    os.killpg(leader.pid, signal.SIGKILL)

    def end(self) -> None:
        """End all processes of the group, and wait for its leader; whoever has started others waits for them."""
        self.kill()
        if self._leader is None:
            return
        leaders, self._leader, self._killed = [*self._killed, self._leader], None, []
        for leader in leaders:
            assert leader.stdin is not None
            leader.stdin.close()
            if os.getpid() == self._home:
                leader.wait()
            else:
                leader.returncode = 0  # it is waited for there

    def __enter__(self) -> ProcessGroup:
        return self

    def __exit__(self, *exc: object) -> None:
        self.end()


def _has_ended(process: subprocess.Popen[bytes]) -> bool:
    """Whether a process has ended, which is not reaped, so that its number stays its own; False where none can tell."""
    if not hasattr(os, "waitid"):  # macOS before Python 3.13
        return False
    return os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


def run_in_group(
    command: Sequence[str],
    *,
    folders: Sequence[Path] = (),
    cwd: Path | str | None = None,
    environment: Mapping[str, str] | None = None,
    seconds: float | None = None,
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end, and return its status and what it wrote: `subprocess.run` in a group of its own.

    The command and all processes that it has started end with this call, whatever happens, and with this process.

    Parameters
    ----------
    command : sequence of str
        Program and arguments.
    folders : sequence of Path
        Folders to remove if this process ends before the command.
    cwd, environment
        Its working folder and environment; those of this process if not given.
    seconds : float, optional
        Longest time in s.

    Raises
    ------
    OSError
        If it can't be started.
    subprocess.TimeoutExpired
        If it has not ended by then.
    """
    with ProcessGroup(*folders) as group:
        process = group.start(
            command,
            cwd=cwd,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
        )
        with process:
            try:
                output, errors = process.communicate(timeout=seconds)
            except BaseException:
                group.kill()
                process.kill()
                raise
    return subprocess.CompletedProcess(command, process.returncode, output, errors)
