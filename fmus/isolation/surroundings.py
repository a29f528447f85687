"""Surroundings of a child: its memory, descriptors, signals and files. It imports the standard library only."""

from __future__ import annotations

import _ctypes
import ctypes
import mmap
import os
import sys
from contextlib import suppress
from typing import Any

_THREAD = 10 << 20  # bytes: the usual stack of a thread, and some more


def look_around(folder: str) -> list[tuple[str, Any]]:
    """Return what an FMU may change in its process: its folder, rounding, signals, threads, children, files."""
    found: list[tuple[str, Any]] = [("folder", os.getcwd()), ("environment", dict(os.environ))]
    for name in ("fegetround", "fegetexcept"):
        with suppress(Exception):
            found.append((name, ctypes.CDLL(None)[name]()))
    with suppress(Exception):  # Python's os.environ doesn't follow the C library's
        pointers, n = ctypes.POINTER(ctypes.c_char_p).in_dll(ctypes.CDLL(None), "environ"), 0
        while pointers and pointers[n]:
            n += 1
        found.append(("variables", n))
    with suppress(Exception):
        import resource

        kinds = (name for name in dir(resource) if name.startswith("RLIMIT_"))
        found.append(("limits", [resource.getrlimit(getattr(resource, name)) for name in kinds]))
    mask = os.umask(0o077)
    os.umask(mask)
    found.append(("umask", mask))
    with suppress(Exception):
        import signal

        found.append(("signal mask", sorted(signal.pthread_sigmask(signal.SIG_BLOCK, []))))
    if os.path.isdir("/proc/self/task"):
        tasks = os.listdir("/proc/self/task")
        children = ""
        for task in tasks:
            with suppress(OSError), open(f"/proc/self/task/{task}/children") as file:
                children += file.read()
        found += [("threads", len(tasks)), ("children", children), ("files", len(os.listdir("/proc/self/fd")))]
        with open("/proc/self/status") as file:
            found += [("signals", line) for line in file if line.startswith(("SigIgn", "SigCgt"))]
    found.append(("libraries", _list_loaded(folder)))
    found.append(("its files", _list_files(folder)))
    return found


def forget() -> None:
    """Set back the C library's random numbers, which `look_around` can't see, as in a process that has just begun."""
    names = ["ucrtbase", "msvcrt"] if sys.platform == "win32" else [None]
    for name in names:
        with suppress(OSError):
            library = ctypes.CDLL(name)
            for seed in ("srand", "srandom"):
                if hasattr(library, seed):
                    library[seed](1)  # by the standard the seed of those that give none
            if sys.platform == "linux":
                library.seed48((ctypes.c_ushort * 3)())


def _list_loaded(folder: str) -> list[str]:
    """Return the libraries in a folder that this process has loaded: some stay, with their memory, when unloaded.

    Those of C++ do, if they share a unique symbol with others.
    """
    folder = os.path.realpath(folder)
    with suppress(OSError), open("/proc/self/maps") as file:
        paths = (line.split(maxsplit=5)[5:] for line in file)
        return sorted({path[0].strip() for path in paths if path and path[0].startswith(folder + os.sep)})
    found = []
    for where, _, names in os.walk(folder):
        for name in names:
            if hasattr(os, "RTLD_NOLOAD") and name.endswith((".so", ".dylib")):
                with suppress(OSError):
                    _ctypes.dlclose(_ctypes.dlopen(os.path.join(where, name), os.RTLD_NOLOAD | os.RTLD_NOW))
                    found.append(name)
    return sorted(found)


def _list_files(folder: str) -> list[Any]:
    """Return names, sizes and times of all files in a folder."""
    found = []
    for where, _, names in os.walk(folder):
        for name in names:
            with suppress(OSError):
                stat = os.stat(os.path.join(where, name))
                found.append((os.path.join(where, name), stat.st_size, stat.st_mtime_ns))
    return sorted(found)


def resident() -> int:
    """Return the memory of this process in bytes; 0 where it isn't known."""
    try:
        with open("/proc/self/statm", "rb") as file:
            return int(file.read().split()[1]) * mmap.PAGESIZE
    except (OSError, ValueError, IndexError):
        try:
            import resource

            return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # bytes on macOS
        except ImportError:
            return 0


def kill_group(group: int | None) -> None:
    """End this process, and those that the FMU has started, unless it has left its group."""
    if group is not None:
        import signal

        if os.getpgid(0) == group:
            os.killpg(0, signal.SIGKILL)
    os._exit(1)


def limit(memory: int) -> None:
    """Limit memory where the system can, and leave no core files."""
    try:
        import resource
    except ImportError:
        return
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if sys.platform == "linux":
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))


def has_room() -> bool:
    """Return whether a thread fits into the limit of memory: without room it may wait for its start for ever."""
    if sys.platform == "linux":
        try:
            mmap.mmap(-1, _THREAD, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS).close()
        except (OSError, MemoryError):
            return False
    return True


def move(descriptor: int) -> int:
    """Return a copy of a descriptor at a number where an FMU closes none by chance."""
    if os.name == "posix":
        import fcntl
        import resource

        most = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        return fcntl.fcntl(descriptor, fcntl.F_DUPFD_CLOEXEC, min(most, 65536) - 16)
    return os.dup(descriptor)


def print_to(path: str) -> None:
    """Let standard output and standard error go to a file, line by line, and standard input be empty."""
    empty = os.open(os.devnull, os.O_RDONLY)
    printed = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
    os.dup2(empty, 0)
    os.dup2(printed, 1)
    os.dup2(printed, 2)
    os.close(empty)
    os.close(printed)
    with suppress(Exception):
        library = ctypes.CDLL(None)
        library.setvbuf(ctypes.c_void_p.in_dll(library, "stdout"), None, 1, ctypes.c_size_t(0))
