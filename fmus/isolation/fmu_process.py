"""A child process that holds an FMU's library, seen from this process: requests, messages, watchdog, end."""

from __future__ import annotations

import ctypes
import json
import mmap
import os
import select
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np

from ...blocks.core import FmuEnd, FmuError, FmuProcessError, describe_disk_error
from ..child_processes import ProcessGroup, find_python, make_temporary_folder, remove_folder
from . import shared_memory
from .end_reasons import read_end
from .shared_memory import (
    CAUSE,
    CHILD_SLEEPS,
    DATA,
    LOG_HEAD,
    MAIL,
    MESSAGES,
    PARENT_SLEEPS,
    PLACE,
    REPLY,
    REQUEST,
    SEQUENCE,
    STATUS,
)

_START = (
    "import sys, types; sys.path[:] = [p for p in sys.path if p]; m = types.ModuleType('loopwright_child'); "
    "m.__path__ = sys.argv[1:2]; sys.modules[m.__name__] = m; from loopwright_child.child import main; main()"
)
_SKIPPED = {"sources", "documentation"}  # folders of an FMU that its library needs not
_LOOKS = 2000
_LOOK = 0.05  # s between two looks at a process that does not answer
_LOADING = 60.0  # s to load a small library of ours


class ChildRequest(NamedTuple):
    """Calls that a child makes at the request of C: the child, the words in shared memory, and the pipes."""

    process: ChildProcess
    sequence: int  # number of the calls
    words: int  # address of the words
    commands: int  # pipe that wakes the process
    replies: int  # pipe by which it wakes this one
    ordered: bool  # False where each request and reply is announced in the pipes
    looks: int  # most looks at a reply before one sleeps


class ChildProcess:
    """A child process: it answers one request at a time.

    It gets a copy of the ``files`` of the unpacked FMU, and shares ``size`` bytes of memory. ``memory`` and ``output``
    are its limits in bytes; see `Isolation`. Its private ``folder`` has ``fmu``, the copy of the files, and ``work``,
    the working folder.
    """

    def __init__(self, name: str, files: Path, size: int, memory: float, output: float):
        self.name, self.size, self.memory_limit, self.output_limit = name, size, int(memory), int(output)
        self.take_message: Callable[[int, str], None] = lambda status, text: None
        self.lose: Callable[[FmuProcessError], FmuProcessError] = lambda error: error
        self.used = self.alive = self.arrived = self._runs_in_c = False
        failed = f"the process for the FMU {name!r} can't be started"
        self.folder = make_temporary_folder(failed, FmuError, prefix="loopwright-fmu-")
        self._peak = 0
        self._output = ChildOutput(self.folder)
        self.number, self._allotted = 0, DATA
        self._watches = shared_memory.ORDERED and _count_cores() > 1
        self.patience = shared_memory.Patience(_LOOKS, may=self._watches)
        self._names: list[list[str]] = []
        self._call = ""
        self._process: subprocess.Popen[bytes] | None = None
        self._group: ProcessGroup | None = None
        try:
            self._spawn(files)
        except OSError as error:
            self.end()
            step = "Load it in this process: isolate=False."
            raise FmuError(f"{failed}: {describe_disk_error(error, self.folder, step)}") from error
        except BaseException:
            self.end()
            raise

    def _spawn(self, files: Path) -> None:
        _copy_files(files, self.folder / "fmu")
        (self.folder / "work").mkdir()
        shared = self.folder / "shared"
        with shared.open("wb") as file:
            file.truncate(self.size)
        with shared.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), self.size)
        self._base = ctypes.addressof(ctypes.c_char.from_buffer(self._memory))
        self.words = memoryview(self._memory).cast("Q")
        self._group = ProcessGroup()  # now, as its keeper started with the folder
        about = {
            "size": self.size,
            "group": self._group.number,
            "memory": self.memory_limit,
            "output": self.output_limit,
            "watches": self._watches,
            "ordered": shared_memory.ORDERED,
            "files": str(self.folder / "fmu"),
            **{name: str(self.folder / name) for name in ("shared", "log", "printed", "mail")},
        }
        here = [str(Path(__file__).parent), json.dumps(about)]
        with open(self.folder / "printed", "wb") as printed:
            self._process = self._group.start(
                [find_python(), "-c", _START, *here],
                cwd=self.folder / "work",
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=printed,
                bufsize=0,
            )
        commands, replies = self._process.stdin, self._process.stdout
        self._in, self._out = (pipe.fileno() for pipe in (commands, replies) if pipe is not None)
        self._poll = _make_poll(self._out)
        self.alive = True

    @property
    def pid(self) -> int | None:
        """Number of the process; None if it has ended."""
        return None if self._process is None else self._process.pid

    # ---- memory ----

    def place(self, n: int) -> int:
        """Return the place of n more bytes of shared memory, for the present instance."""
        start = self._allotted
        if start + n > self.size:
            raise FmuError(
                f"{n} bytes don't fit into the {self.size} bytes of memory that are shared with the FMU's process. "
                "Take fewer ports, or isolate=False."
            )
        self._allotted = start + (n + 63) // 64 * 64
        return start

    def array(self, n: int, ctype: Any) -> np.ndarray:
        """Return an array (n,) in the shared memory."""
        dtype = np.dtype(ctype)
        found = np.frombuffer(self._memory, dtype=dtype, count=n, offset=self.place(max(1, n) * dtype.itemsize))
        found[:] = 0
        return found

    def value(self, ctype: Any) -> Any:
        """Return a C value in the shared memory, zero at first."""
        n = ctypes.sizeof(ctype)
        at = self.place(n)
        self._memory[at : at + n] = bytes(n)
        return ctype.from_buffer(self._memory, at)

    def find(self, address: int) -> int | None:
        """Return the place of an address in the shared memory; None if it isn't there."""
        return place if DATA <= (place := address - self._base) < self._allotted else None

    # ---- requests ----

    def request(
        self, operation: str, *arguments: Any, blobs: Sequence[bytes] = (), call: str, seconds: float
    ) -> tuple[Any, list[bytes]]:
        """Let the child do its method ``do_…`` with numbers, texts and lists, and with bytes, and return its result.

        ``call`` is the call of the FMU, for an error; after ``seconds`` the process is ended. An exception of the child
        is a `RuntimeError` here.
        """
        self._call = call
        self.check_alive(call)
        memory, words, file = self._memory, self.words, str(self.folder / "mail")
        shared_memory.write_message(memory, words, file, [operation, *arguments], blobs)
        self.post(MAIL)
        self.finish(MAIL, seconds)
        try:
            (succeeded, result), data = shared_memory.read_message(memory, words, file)
        except (OSError, ValueError, struct.error) as error:  # the FMU has written over it
            self._fail(call, error=error)
        if not succeeded:
            self.used = True
            raise RuntimeError(result)
        return result, data

    def bind(self, calls: list[Any], blobs: list[bytes], seconds: float) -> int:
        """Bind a sequence in the child, and return its number."""
        number = int(self.request("bind", calls, blobs=blobs, call="binding its calls", seconds=seconds)[0])
        self._names[number:] = [[name for name, _ in calls]]
        return number

    def post(self, sequence: int) -> None:
        """Begin to run a bound sequence, or to read the mailbox."""
        words = self.words
        if not self.alive:
            self.check_alive(self._place_name(sequence))
        words[SEQUENCE] = sequence
        words[REQUEST] = self.number = self.number + 1
        shared_memory.order_memory()
        if words[CHILD_SLEEPS] or not shared_memory.ORDERED:
            self.wake(sequence)

    def wake(self, sequence: int) -> None:
        """Wake the child, which sleeps."""
        try:
            os.write(self._in, shared_memory.WAKE)
        except OSError as error:
            self._fail(self._place_name(sequence), error=error)

    def finish(self, sequence: int, seconds: float) -> int:
        """Return the status of a sequence that was posted; see `failed_place`."""
        number, get, patience = self.number, self.words.__getitem__, self.patience
        try:
            for _ in range(patience.looks):
                if get(REPLY) == number:
                    patience.pause = shared_memory.FEWEST
                    break
            else:
                patience.slept()
                self.sleep(sequence, number, seconds)
        except FmuProcessError:
            raise
        except BaseException:  # an interrupt: the reply is still to come
            self.give_up()
            raise
        return self.collect()

    def collect(self) -> int:
        """Return the status of a sequence whose reply is there."""
        self.arrived = False
        if self.words[MESSAGES]:
            self.fetch_messages()
        return self.words[STATUS]

    def request_of(self, sequence: int) -> ChildRequest | None:
        """Return a bound sequence as C asks for it; None where C can't sleep for its reply."""
        if os.name != "posix":
            return None
        looks = _LOOKS if self._watches else 0
        return ChildRequest(self, sequence, self._base, self._in, self._out, shared_memory.ORDERED, looks)

    def run_in_c(self, library: str) -> None:
        """Let the child wait for requests and make bound calls in C, by a library, where it can."""
        if not self._runs_in_c:
            self._runs_in_c = True
            self.request("run_in_c", library, call="making its calls in C", seconds=_LOADING)

    def bind_in_c_again(self) -> None:
        """Let C in the child read the arguments of all bound calls again, which it has copied; see `run_in_c`."""
        if self._runs_in_c:
            self.request("bind_in_c_again", call="binding its calls", seconds=_LOADING)

    def give_up(self) -> None:
        """End the process after an interrupt in a call."""
        self.used = True
        self.end()

    def sleep(self, sequence: int, number: int, seconds: float) -> None:
        """Sleep until the reply is there."""
        words, deadline = self.words, time.monotonic() + seconds
        words[PARENT_SLEEPS] = 1
        shared_memory.order_memory()
        arrived = shared_memory.ORDERED  # else the byte in the pipe says that the reply is written
        while words[REPLY] != number or not arrived:
            if _is_readable(self._poll, self._out, _LOOK):
                arrived = True
                if not os.read(self._out, 4096) and words[REPLY] != number:
                    self._fail(self._place_name(sequence))
            elif words[REPLY] != number:
                if self.has_ended():
                    self._fail(self._place_name(sequence))
                if time.monotonic() >= deadline:
                    self._fail(self._place_name(sequence), FmuEnd.TIMEOUT, seconds=seconds)
        words[PARENT_SLEEPS] = 0

    @property
    def failed_place(self) -> int:
        """Place of the call at which the last sequence ended."""
        return int(self.words[PLACE])

    def _place_name(self, sequence: int) -> str:
        if sequence == MAIL:
            return self._call
        names = self._names[sequence]
        return names[min(self.failed_place, len(names) - 1)]

    # ---- messages ----

    def fetch_messages(self) -> None:
        """Give the FMU's log messages to `take_message`."""
        self.words[MESSAGES] = 0
        for status, text in self._output.read_messages():
            self.take_message(status, text)

    def read_printed(self) -> list[str]:
        """Return the last lines that the FMU has written since the present instance was made."""
        return self._output.read_printed()

    # ---- the end ----

    def check_alive(self, call: str) -> None:
        """Raise the error of a process that has ended before a call."""
        if not self.alive:
            text = f"the process of the FMU {self.name!r} has ended before {call}. Run it again."
            raise self.lose(FmuProcessError(text, call=call, cause=FmuEnd.LOST))

    def has_ended(self) -> bool:
        """Return whether the process has ended; it isn't reaped, so that its memory can be asked for."""
        process = self._process
        if process is None or process.returncode is not None:
            return True
        if hasattr(os, "waitid"):
            with suppress(ChildProcessError):
                return os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
        return process.poll() is not None

    def _fail(
        self, call: str, cause: FmuEnd | None = None, *, seconds: float = 0.0, error: Exception | None = None
    ) -> NoReturn:
        """End the process, and raise the error that says why."""
        for _ in range(500):  # the pipe closes before the process has ended, on a busy machine long before
            if cause is not None or self.has_ended():
                break
            time.sleep(0.01)
        self.fetch_messages()
        printed = self._output.read_printed()
        noted, by_itself = int(self.words[CAUSE]), self.has_ended()
        status = self._finish_process()
        error = None if by_itself else error
        if cause is None:
            cause, text = read_end(status, noted, error, self._peak, self.memory_limit, self.output_limit)
        else:
            text = f"{call} has not ended after {seconds:g} s; its process was ended"
        said = f" It wrote: {' / '.join(printed)}." if printed else ""
        found = FmuProcessError(
            f"{text}{'' if cause is FmuEnd.TIMEOUT else f' in {call}'} (FMU {self.name!r}, in its own process).",
            call=call,
            cause=cause,
            printed=said,
        )
        self.used = True
        self.end()
        raise self.lose(found) from None

    def _finish_process(self) -> int | None:
        """End the process and its group; return the status with which it ended by itself, None if it had not."""
        process = self._process
        if process is None:
            return None
        ended = self.has_ended()
        if self._group is not None:
            self._group.kill()
        if not ended:
            with suppress(OSError):
                process.kill()
        if ended and process.returncode is None and hasattr(os, "wait4"):
            with suppress(ChildProcessError):
                _, code, usage = os.wait4(process.pid, 0)
                process.returncode = os.waitstatus_to_exitcode(code)
                self._peak = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
        with suppress(subprocess.TimeoutExpired):
            process.wait(10.0)
        return process.returncode if ended else None

    def end(self) -> None:
        """End the process with all that the FMU has started in it, and remove its folder."""
        self.alive = False
        self._finish_process()
        if self._process is not None:
            for pipe in (self._process.stdin, self._process.stdout):
                if pipe is not None:
                    with suppress(OSError):
                        pipe.close()
            self._process = None
        if self._group is not None:
            self._group.end()
        remove_folder(self.folder)

    def disown(self) -> None:
        """Leave the process to the one that this process is a fork of."""
        self.alive, self.used = False, True
        if self._process is not None:
            self._process.returncode = 0  # it is waited for there
            self._process = None
        self.folder = self.folder / "disowned"

    def begin_again(self) -> None:
        """Prepare for another instance: forget memory, sequences and messages."""
        self._allotted = DATA
        self._names.clear()
        self.take_message, self.lose = lambda status, text: None, lambda error: error
        self._output.begin_again()
        self.words[MESSAGES] = 0


_LAST_LINES = 5


class ChildOutput:
    """Files of a child: ``log`` and ``printed`` in its folder."""

    def __init__(self, folder: Path):
        self.folder, self._position, self._printed = folder, 0, 0

    def begin_again(self) -> None:
        """Forget what has been printed so far."""
        with suppress(OSError):
            self._printed = (self.folder / "printed").stat().st_size

    def read_messages(self) -> Iterator[tuple[int, str]]:
        """Yield status and text of each log message that hasn't been read yet."""
        data = b""
        with suppress(OSError), open(self.folder / "log", "rb") as file:
            file.seek(self._position)
            data = file.read()
        at = 0
        while at + LOG_HEAD.size <= len(data):
            status, n = LOG_HEAD.unpack_from(data, at)
            start = at + LOG_HEAD.size
            if start + n > len(data):
                break
            at = start + n
            self._position += LOG_HEAD.size + n
            yield status, data[start:at].decode(errors="replace")

    def read_printed(self) -> list[str]:
        """Return the last lines that the FMU has written to its standard output and standard error."""
        with suppress(OSError), open(self.folder / "printed", "rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - 4096, self._printed if self._printed <= size else 0))  # it may have begun again
            lines = file.read().decode(errors="replace").splitlines()
            return [line.strip() for line in lines if line.strip()][-_LAST_LINES:]
        return []


def _count_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _copy_files(source: Path, target: Path) -> None:
    """Copy the files of an FMU that its library may read or write: sources and documentation are left out.

    An `OSError` is that of the first file: that of shutil lists the texts of all.
    """
    faults: list[OSError] = []

    def copy(one: str, other: str) -> None:
        try:
            shutil.copy2(one, other)
        except OSError as error:
            faults.append(error)
            raise

    def skip(where: str, names: Sequence[str]) -> set[str]:
        return _SKIPPED & {*names} if where == str(source) else set()

    try:
        shutil.copytree(source, target, ignore=skip, copy_function=copy)
    except shutil.Error as error:
        raise (faults or [error])[0] from error


def _make_poll(pipe: int) -> Any:
    """Return the system's object that waits for a pipe; None where there is none."""
    if not hasattr(select, "poll"):
        return None
    poll = select.poll()
    poll.register(pipe, select.POLLIN)
    return poll


def _is_readable(poll: Any, pipe: int, seconds: float) -> bool:
    """Wait for some seconds at most, and return whether there is a byte in the pipe, or the pipe is closed."""
    if poll is not None:
        return bool(poll.poll(seconds * 1000))
    import _winapi  # not tried
    import msvcrt

    handle, end = msvcrt.get_osfhandle(pipe), time.monotonic() + seconds  # type: ignore[attr-defined]
    while True:
        try:
            if _winapi.PeekNamedPipe(handle, 0)[0]:  # type: ignore[attr-defined]
                return True
        except OSError:
            return True  # closed: reading says so
        if time.monotonic() >= end:
            return False
        time.sleep(0.0005)
