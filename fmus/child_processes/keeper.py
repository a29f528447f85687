"""The keeper of this process: it ends the groups and removes the folders that this process leaves behind.

A worker or a compiler does not notice while it computes that its host has been killed, and a thread that looks for the
host needs the interpreter lock, which others may hold. So one small process does nothing else (`keeper_process`). It is
started when it is needed first, and ends when nothing is kept.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from ...blocks.core import LoopwrightError

_SCRIPT = str(Path(__file__).with_name("keeper_process.py"))
POSIX = os.name == "posix"
_LONGEST_END = 10.0  # s that a keeper may take to end all and itself


def find_python() -> str:
    """Return the program of this Python."""
    if not sys.executable:
        raise LoopwrightError(
            f"sys.executable is {sys.executable!r}, so that no other Python process can be started; expected the path "
            "of Python's program, which a program that embeds Python may not know. Set it, such as "
            "sys.executable = '/usr/bin/python3'."
        )
    return sys.executable


class Keeper:
    """A process that keeps groups and folders; `current_keeper` returns the present one."""

    def __init__(self) -> None:
        if POSIX:
            options: dict[str, Any] = {"process_group": 0, "cwd": "/"}  # the present folder may be removed
        else:
            options = {"creationflags": 0x200, "cwd": os.environ.get("SYSTEMROOT")}  # CREATE_NEW_PROCESS_GROUP
        self._process = subprocess.Popen(
            [find_python(), "-I", "-S", _SCRIPT, str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            bufsize=0,
            **options,
        )
        self._numbers = itertools.count()
        self.kept: set[int | str] = set()
        """Groups and folders."""

    def send(self, request: str, folder: str) -> None:
        """Write a request about a folder; an `OSError` if the keeper has ended."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{request} {os.fsencode(folder).hex()}\n".encode())

    def make_group(self) -> int:
        """Return the number of a new group of processes; an `OSError` if the keeper has ended, or can't make one."""
        group = self._ask("group")
        if not group:
            raise BlockingIOError("no room for one more process")
        return group

    def end_group(self, group: int) -> None:
        """End a group of processes; the first one of it is gone at the return."""
        self._ask("end", group)

    def _ask(self, request: str, *subject: int) -> int:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        number = next(self._numbers)
        self._process.stdin.write(f"{' '.join(map(str, (request, number, *subject)))}\n".encode())
        while line := self._process.stdout.readline():
            answered, result = map(int, line.split())
            if answered == number:  # else the caller of that one was interrupted
                return result
        raise ProcessLookupError("the process that keeps them has ended")

    def has_ended(self) -> bool:
        """Return whether somebody has ended the keeper, and with it all groups."""
        return self._process.poll() is not None

    def end(self) -> None:
        """End the keeper, which keeps nothing."""
        self._process.kill()  # a fork of this process may hold the pipe open
        self.close()
        self._process.wait()

    def close(self) -> None:
        """Close the pipes to the keeper; a fork of its host does so, as the keeper isn't the fork's."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()

    def wait(self, seconds: float) -> None:
        """Wait at most so many seconds for a keeper whose pipes are closed: it ends by itself."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)

    def disown(self) -> None:
        """Leave the keeper to the process that this one is a fork of."""
        self.close()
        self._process.returncode = 0  # it is waited for there


_LOCKS = [threading.RLock()]
_KEEPERS: list[Keeper] = []
"""The present keeper, if there is one."""


def _current() -> Keeper:
    """Return the present keeper, after starting it if there is none."""
    if _KEEPERS and _KEEPERS[0].has_ended():
        lost = _KEEPERS.pop()
        lost.close()
        for folder in [kept for kept in lost.kept if isinstance(kept, str)]:
            _keep_folder(folder)
    if not _KEEPERS:
        _KEEPERS.append(Keeper())
    return _KEEPERS[0]


def _keep_folder(folder: str) -> None:
    keeper = _current()
    keeper.kept.add(folder)
    keeper.send("folder", folder)


def _release(keeper: Keeper, subject: int | str, send: Callable[[], None]) -> None:
    """Tell a keeper that it keeps something no longer; the last one lets it end."""
    keeper.kept.discard(subject)
    with suppress(OSError, ValueError):  # one that was ended by somebody else keeps nothing
        send()
    if not keeper.kept and keeper in _KEEPERS:
        _KEEPERS.remove(keeper)
        keeper.end()


def make_group() -> tuple[Keeper, int]:
    """Return a new group of processes that ends with this process, and its keeper."""
    with _LOCKS[0]:
        keeper = _current()
        try:
            group = keeper.make_group()
        finally:
            if not keeper.kept and keeper.has_ended():
                _KEEPERS.clear()
        keeper.kept.add(group)
    return keeper, group


def release_group(keeper: Keeper, group: int) -> None:
    """End a group of processes, and forget it."""
    with _LOCKS[0]:
        _release(keeper, group, partial(keeper.end_group, group))


def keep_folder(folder: str | os.PathLike[str]) -> None:
    """Let a folder be removed if this process ends before `release_folder`, as far as a process can be started."""
    with _LOCKS[0], suppress(OSError, LoopwrightError):
        _keep_folder(os.path.abspath(folder))


def release_folder(folder: str | os.PathLike[str]) -> None:
    """Let a folder that has been removed be forgotten."""
    path = os.path.abspath(folder)
    with _LOCKS[0]:
        for keeper in [keeper for keeper in _KEEPERS if path in keeper.kept]:
            _release(keeper, path, partial(keeper.send, "removed", path))


def end_all() -> None:
    """End all groups and remove all folders that are kept, as the end of this process does; then none is left.

    A process that is about to end calls it, so that whoever waits for its end finds nothing of it.
    """
    with _LOCKS[0]:
        while _KEEPERS:
            keeper = _KEEPERS.pop()
            keeper.close()
            keeper.wait(_LONGEST_END)


def _forget() -> None:
    """Leave the keeper to the process that this one is a fork of."""
    _LOCKS[0] = threading.RLock()
    while _KEEPERS:
        _KEEPERS.pop().disown()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
