"""Groups of child processes, which end with this process, however it ends.

On POSIX a group of processes is ended by a signal that no process can refuse, by this process or by its keeper. On
Windows it is a job object.
"""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from .job import CREATE_NEW_PROCESS_GROUP, CREATE_SUSPENDED, Job
from .keeper import POSIX, Keeper, make_group, release_group


class ProcessGroup:
    """Child processes that end with this process, or with `end`, and with them all processes that they start.

    A process is in the group before its program begins: at no moment could one be left behind. An `OSError` says that
    the group can't be made.
    """

    def __init__(self) -> None:
        self._home = os.getpid()
        self._groups: list[tuple[Keeper, int]] = [make_group()] if POSIX else []
        """The present group, after those whose keeper was ended by somebody else."""
        self._job = None if POSIX else Job()

    @property
    def number(self) -> int | None:
        """Number of the group of processes; None on Windows, and after its end."""
        return self._groups[-1][1] if self._groups else None

    def start(self, command: Sequence[str], **options: Any) -> subprocess.Popen[Any]:
        """Start a process in the group, as `subprocess.Popen`; an `OSError` if it can't, or if the group has ended."""
        if self._job is not None:
            flags = options.pop("creationflags", 0) | CREATE_SUSPENDED | CREATE_NEW_PROCESS_GROUP
            process = subprocess.Popen(command, creationflags=flags, **options)
            try:
                self._job.take(int(process._handle), process.pid)  # type: ignore[attr-defined]
            except BaseException:
                process.kill()
                process.wait()
                raise
            return process
        if not self._groups:
            raise ProcessLookupError("its group of processes has ended")
        if self._groups[-1][0].has_ended():
            self._groups.append(make_group())
        return subprocess.Popen(command, process_group=self._groups[-1][1], **options)

    def kill(self) -> None:
        """End all processes of the group; whoever has started them waits for them."""
        if self._job is not None:
            self._job.kill()
        if os.getpid() == self._home:  # a fork of this process leaves the group alone
            for keeper, group in self._groups:
                if not keeper.has_ended():  # else the group's number may be that of another one
                    with suppress(OSError):
                        os.killpg(group, signal.SIGKILL)

    def end(self) -> None:
        """End all processes of the group, and the group itself; whoever has started them waits for them."""
        self.kill()
        if self._job is not None:
            self._job.end()
        groups, self._groups = self._groups, []
        if os.getpid() == self._home:
            for keeper, group in groups:
                release_group(keeper, group)

    def __enter__(self) -> ProcessGroup:
        return self

    def __exit__(self, *exc: object) -> None:
        self.end()


def run_in_group(
    command: Sequence[str],
    *,
    cwd: Path | str | None = None,
    environment: Mapping[str, str] | None = None,
    seconds: float | None = None,
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end, and return its status and output: `subprocess.run` in a group.

    The command and all processes that it has started end with this call, whatever happens, and with this process. After
    ``seconds`` it is a `subprocess.TimeoutExpired`.
    """
    with ProcessGroup() as group:
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
