"""Processes that are kept for the next instance of their FMU, and the end of all of them."""

from __future__ import annotations

import atexit
import gc
import os
import threading
import time
from contextlib import suppress
from pathlib import Path

from .fmu_process import ChildProcess

_MOST_IDLE, _IDLE_TIME = 4, 20.0
"""Number of idle processes, and seconds after which an idle one is ended."""
_COLLECTED_AT = 8
"""Number of processes in use at which garbage is collected, as circles of references may hold FMUs."""
Key = tuple[str, int, int, bool]
"""Digest of the FMU, limits of memory and output, and whether it is kept."""

_LOCKS = [threading.RLock()]
_IDLE_ONES: list[tuple[Key, ChildProcess, float]] = []
_ALL: dict[int, tuple[Key, ChildProcess]] = {}
_TIMER: list[threading.Timer] = []
_COLLECTED_NEXT = [_COLLECTED_AT]
"""Number of processes in use at which garbage is collected next: twice those that the last collection left."""


def take(key: Key, name: str, files: Path, size: int) -> ChildProcess:
    """Return a process for an instance of an FMU, with ``size`` bytes of shared memory: an idle one, else a new one."""
    while True:
        with _LOCKS[0]:
            found = next((entry for entry in reversed(_IDLE_ONES) if entry[0] == key), None)
            if found is None:
                break
            _IDLE_ONES.remove(found)
        process = found[1]
        if not process.has_ended() and process.size >= size:
            process.begin_again()
            return process
        _drop(process)
    if len(_ALL) - len(_IDLE_ONES) >= _COLLECTED_NEXT[0]:
        gc.collect()
        _COLLECTED_NEXT[0] = max(_COLLECTED_AT, 2 * (len(_ALL) - len(_IDLE_ONES)))
    process = ChildProcess(name, files, size, key[1], key[2])
    with _LOCKS[0]:
        _ALL[id(process)] = key, process
    return process


def give_back(process: ChildProcess, clean: bool) -> None:
    """Keep a process whose instance is freed and has left no traces; end any other."""
    with _LOCKS[0]:
        key = _ALL[id(process)][0] if id(process) in _ALL else None
        keeps = clean and key is not None and key[3] and process.alive and not process.used
        if keeps and key is not None:
            _IDLE_ONES.append((key, process, time.monotonic()))
            surplus = [_IDLE_ONES.pop(0)[1] for _ in range(len(_IDLE_ONES) - _MOST_IDLE)]
            _set_timer()
        else:
            surplus = [process]
    for other in surplus:
        _drop(other)


def _drop(process: ChildProcess) -> None:
    process.end()
    with _LOCKS[0]:
        _ALL.pop(id(process), None)


def _set_timer() -> None:
    """Look at the idle ones after a while; a daemon, so that the end of Python doesn't wait for it."""
    if not _TIMER and _IDLE_ONES:
        timer = threading.Timer(_IDLE_TIME / 2, end_idle, kwargs={"seconds": _IDLE_TIME})
        timer.daemon = True
        _TIMER.append(timer)
        timer.start()


def end_idle(seconds: float = 0.0) -> None:
    """End the processes that have been idle for so many seconds."""
    with _LOCKS[0]:
        while _TIMER:
            _TIMER.pop().cancel()
        old = [entry for entry in _IDLE_ONES if time.monotonic() - entry[2] >= seconds]
        _IDLE_ONES[:] = [entry for entry in _IDLE_ONES if entry not in old]
        _set_timer()
    for _, process, _ in old:
        _drop(process)


def count_processes() -> tuple[int, int]:
    """Return the number of processes, and of idle ones among them."""
    with _LOCKS[0]:
        return len(_ALL), len(_IDLE_ONES)


def _end_all() -> None:
    with _LOCKS[0]:
        every = [process for _, process in _ALL.values()]
        _IDLE_ONES.clear()
    for process in every:
        with suppress(Exception):
            _drop(process)


def _forget() -> None:
    """Forget all processes in a fork of this process: they belong to the other one."""
    _LOCKS[0] = threading.RLock()
    for _, process in _ALL.values():
        process.disown()
    _IDLE_ONES.clear()
    _ALL.clear()
    _TIMER.clear()


atexit.register(_end_all)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
