"""The child: calls functions of an FMU's library, as it is asked.

It imports the standard library only, to start quickly. It reads frames from its command pipe, and numbers of bound
sequences from the shared words (`shared_memory`). All that the FMU writes to its standard output goes to a file, and
its log messages to another one, so that they are there after a crash.
"""

from __future__ import annotations

import _ctypes
import ctypes
import json
import mmap
import os
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from . import shared_memory
from .callbacks import InputLines, log_and_memory
from .child_in_c import TYPES, Server, make_watch
from .shared_memory import (
    CAUSE,
    CHILD_SLEEPS,
    MAIL,
    MEMORY,
    MESSAGES,
    NO_ROOM,
    OUTPUT,
    PARENT_SLEEPS,
    PLACE,
    REPLY,
    REQUEST,
    SEQUENCE,
    STATUS,
    WAKE,
)
from .surroundings import forget, has_room, kill_group, limit, look_around, move, print_to, resident

_LOOKS = 4000
_PERIOD = 0.25  # s between two looks at memory and output
_KEPT_OUTPUT = 16 << 20  # bytes of output at which its file begins again


class Child:
    """The process: its pipes, its shared memory, its library."""

    def __init__(self, commands: int, replies: int, about: dict[str, Any]):
        self.commands, self.replies, self.about = commands, replies, about
        self.me = os.getpid()
        with open(about["shared"], "r+b") as file:
            self.memory = mmap.mmap(file.fileno(), about["size"])
        self.ordered, self.logged, self.is_own = about["ordered"], 0, False
        with suppress(AttributeError, OSError):  # a copy of the process has no part in it
            self.memory.madvise(mmap.MADV_DONTFORK)
            self.is_own = True
        self.base = ctypes.addressof(ctypes.c_char.from_buffer(self.memory))
        self.words = memoryview(self.memory).cast("Q")
        self.log = os.open(about["log"], os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        self.library: Any = None
        self.kept: list[Any] = []  # as long as the library may use it
        self.sequences: list[Callable[[], None]] = []
        self.bound: list[list[tuple[Any, list[tuple[str, Any]]]]] = []
        self.server: Server | None = None
        """Waits for requests in C; None before `do_run_in_c`."""
        self.before: list[Any] = []
        self.lines: InputLines | None = None
        self._logging = threading.Lock()

    # ---- requests ----

    def serve(self) -> None:
        """Answer requests until the parent is gone."""
        words, sequences, last = self.words, self.sequences, 0
        get, patience = words.__getitem__, shared_memory.Patience(_LOOKS, may=self.about["watches"])
        while True:
            if self.server is not None:
                if not self.server.wait(last):
                    self.leave()
            else:
                for _ in range(patience.looks):
                    if get(REQUEST) != last:
                        patience.pause = shared_memory.FEWEST
                        break
                else:
                    patience.slept()
                    if not self.ordered:
                        self._sleep(last)
                    while get(REQUEST) == last:
                        self._sleep(last)
            last = get(REQUEST)
            if get(SEQUENCE) == MAIL:
                self._answer()
            else:
                sequences[get(SEQUENCE)]()
            words[REPLY] = last
            shared_memory.order_memory()
            if words[PARENT_SLEEPS] or not self.ordered:
                os.write(self.replies, WAKE)

    def _sleep(self, last: int) -> None:
        """Sleep until there is a request, or a byte of an earlier one."""
        words = self.words
        words[CHILD_SLEEPS] = 1
        shared_memory.order_memory()
        if (words[REQUEST] == last or not self.ordered) and not os.read(self.commands, 4096):
            self.leave()
        words[CHILD_SLEEPS] = 0

    def _bind_run(self, calls: list[tuple[Callable[..., int], tuple[Any, ...]]]) -> Callable[[], None]:
        """Return a function that runs a bound sequence, with everything looked up before."""
        words, place_at, status_at = self.words, PLACE, STATUS
        numbered = tuple((place, function, arguments) for place, (function, arguments) in enumerate(calls))

        def run() -> None:
            worst = warned = 0
            for place, function, arguments in numbered:
                words[place_at] = place
                status = function(*arguments)
                if not 0 <= status <= 1:
                    worst = status
                    break
                if status:
                    worst, warned = status, warned | 1 << min(place, 62)
            else:
                words[place_at] = warned
            if not self.is_own:
                self._leave_copy()
            words[status_at] = worst & 0xFFFFFFFF

        return run

    def _leave_copy(self) -> None:
        """End this process if the FMU has made it from the child: the child itself continues."""
        if os.getpid() != self.me:
            os._exit(0)

    def _answer(self) -> None:
        """Do what the message in the mailbox says, and put the result there."""
        memory, words, file = self.memory, self.words, self.about["mail"]
        (operation, *arguments), blobs = shared_memory.read_message(memory, words, file)
        try:
            result, data = getattr(self, f"do_{operation}")(*arguments, blobs=blobs)
        except Exception as error:
            succeeded, result, data = False, f"{error}", []
        else:
            succeeded = True
        self._leave_copy()
        shared_memory.write_message(memory, words, file, [succeeded, result], data)

    # ---- operations ----

    def do_load(self, path: str, names: list[str], blobs: list[bytes]) -> tuple[Any, list[bytes]]:
        """Load the library, and return which of some functions it exports."""
        forget()
        if not self.before:
            self.before = look_around(self.about["files"])
        here = os.getcwd()
        os.chdir(os.path.dirname(path))
        try:
            self.library = ctypes.CDLL(path)
        finally:
            os.chdir(here)
        return [name for name in names if hasattr(self.library, name)], []

    def do_has(self, name: str, blobs: list[bytes]) -> tuple[bool, list[bytes]]:
        """Return whether the library exports a function."""
        return hasattr(self.library, name), []

    def do_call(
        self, name: str, result: str, arguments: list[Any], blobs: list[bytes]
    ) -> tuple[tuple[Any, list[Any]], list[bytes]]:
        """Call a function; return its result, texts that it has left, and the bytes of the buffers."""
        function = self.library[name]
        function.restype = TYPES[result] if result else None
        data, buffers, texts = iter(blobs), [], []
        made: list[Any] = []
        for kind, value in arguments:
            if kind == "buffer":
                raw = next(data)
                buffer = (ctypes.c_char * max(1, len(raw))).from_buffer_copy(raw or b"\0")
                buffers.append((buffer, len(raw)))
                made.append(buffer)
            elif kind == "texts":
                array = (ctypes.c_char_p * max(1, len(value)))(*(None if v is None else _bytes(v) for v in value))
                texts.append((array, len(value)))
                made.append(array)
            elif kind == "shared":
                made.append(ctypes.c_void_p(self.base + value))
            elif kind == "callbacks":
                made.append(self._callbacks(value))
            else:
                made.append(TYPES[kind](_bytes(value) if kind in "zc" and value is not None else value))
        found = function(*made)
        found = found.decode("latin-1") if isinstance(found, bytes) else found
        if "nstantiate" in name:  # FMUs of FMI 1.0 and 2.0 may keep its texts and callbacks
            self.kept.append(made)
        left = [[None if v is None else v.decode("latin-1") for v in array[:n]] for array, n in texts]
        return (found, left), [bytes(buffer)[:n] for buffer, n in buffers]

    def do_bytes(self, pieces: list[tuple[int, int]], blobs: list[bytes]) -> tuple[None, list[bytes]]:
        """Return the bytes at addresses that the FMU has given."""
        return None, [ctypes.string_at(address, n) if address and n else b"" for address, n in pieces]

    def do_set_bytes(self, name: str, arguments: list[Any], blobs: list[bytes]) -> tuple[Any, list[bytes]]:
        """Call a function that takes pointers to pieces of bytes."""
        component, references, sizes = arguments
        pieces = [ctypes.create_string_buffer(b, max(1, len(b))) for b in blobs]
        n = len(references)
        pointers = (ctypes.c_void_p * max(1, len(pieces)))(*(ctypes.addressof(p) for p in pieces))
        status = self.library[name](
            *(ctypes.c_void_p(component), (ctypes.c_uint * max(1, n))(*references), ctypes.c_size_t(n)),
            *((ctypes.c_size_t * max(1, len(sizes)))(*sizes), pointers, ctypes.c_size_t(len(pieces))),
        )
        return status, []

    def do_bind(self, calls: list[Any], blobs: list[bytes]) -> tuple[int, list[bytes]]:
        """Bind functions to arguments in the shared memory, and return the number of the sequence."""
        data, bound = iter(blobs), []
        for name, arguments in calls:
            made: list[tuple[str, Any]] = []
            for kind, value in arguments:
                if kind == "shared":
                    made.append(("P", ctypes.c_void_p(self.base + value)))
                elif kind == "constant":
                    raw = next(data)
                    made.append(("P", ctypes.create_string_buffer(raw, max(1, len(raw)))))
                    self.kept.append(made[-1])
                elif kind == "live":
                    made.append((value[0], TYPES[value[0]].from_buffer(self.memory, value[1])))
                else:
                    made.append((kind, TYPES[kind](value)))
            function = make_watch() if name == shared_memory.WATCH_TEXTS else self.library[name]
            function.restype = ctypes.c_int
            bound.append((function, made))
        self.bound.append(bound)
        self.sequences.append(self._bind_run([(f, tuple(value for _, value in made)) for f, made in bound]))
        if self.server is not None:
            self.server.take(self.bound)
        return len(self.sequences) - 1, []

    def do_run_in_c(self, library: str, blobs: list[bytes]) -> tuple[bool, list[bytes]]:
        """Wait for requests and make bound calls in C from now on; return whether that is possible here."""
        if self.server is None and self.is_own and os.name == "posix":
            looks = _LOOKS if self.about["watches"] else 0
            with suppress(OSError, AttributeError):  # an FMU may have taken all descriptors
                self.server = Server(library, self.base, self.commands, self.replies, self.ordered, looks)
                self.server.take(self.bound)
        return self.server is not None, []

    def do_bind_in_c_again(self, blobs: list[bytes]) -> tuple[None, list[bytes]]:
        """Let C take the arguments of bound calls again: their instance is another one."""
        if self.server is not None:
            self.server.take(self.bound)
        return None, []

    def do_follow(
        self, place: int, references: list[int], n: int, instance: int, blobs: list[bytes]
    ) -> tuple[None, list[bytes]]:
        """Let inputs follow lines within a step; the parent writes them and the instance to the shared memory."""
        numbers = (ctypes.c_double * (2 + 2 * n)).from_buffer(self.memory, place)
        component = ctypes.c_void_p.from_buffer(self.memory, instance)
        self.lines = InputLines(numbers, references, component, self.library["fmi3SetFloat64"])
        return None, []

    def _update_inputs(self, environment: Any, t: float, can_set: bool, *others: Any) -> None:
        """Set the inputs at a time within a step; called by the FMU."""
        if can_set and self.lines is not None:
            self.lines.set_at(t)

    def do_unload(self, blobs: list[bytes]) -> tuple[list[str], list[bytes]]:
        """Unload the library, and return traces of the FMU in this process: with any, it is used no more."""
        self.sequences.clear()
        self.bound.clear()
        if self.server is not None:
            self.server.take([])
        self.lines = None
        handle, self.library = self.library._handle, None
        self.kept.clear()
        if sys.platform == "win32":
            _ctypes.FreeLibrary(handle)
        else:
            _ctypes.dlclose(handle)
        after = look_around(self.about["files"])
        return [name for (name, old), (_, new) in zip(self.before, after, strict=True) if old != new], []

    # ---- log messages ----

    def _keep_message(self, status: int, text: str) -> None:
        if not status:
            return
        with self._logging:
            if self.words[MESSAGES] < shared_memory.MOST_MESSAGES and self.logged < shared_memory.MOST_LOGGED:
                data = text.encode(errors="replace")[: shared_memory.LONGEST_MESSAGE]
                self.logged += len(data)
                os.write(self.log, shared_memory.LOG_HEAD.pack(status, len(data)) + data)
                self.words[MESSAGES] += 1

    def _callbacks(self, version: int) -> Any:
        """Return the callbacks of a version of FMI: the logger alone, and the C library's memory.

        Number 4 is the callback of FMI 3.0 that sets inputs within a step.
        """
        if version == 4:
            flag, number = ctypes.c_bool, ctypes.c_double
            update = ctypes.CFUNCTYPE(
                *(None, ctypes.c_void_p, number, flag, flag, flag, flag), ctypes.POINTER(flag), ctypes.POINTER(number)
            )
            return self._keep(update(self._update_inputs))
        if version == 3:

            def message3(environment: Any, status: int, category: bytes | None, text: bytes | None) -> None:
                self._keep_message(status, (text or b"").decode(errors="replace"))

            kind = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_char_p)
            return self._keep(kind(message3))

        pointers, logger = log_and_memory(self._keep_message)
        self._keep(logger)
        if version == 1:

            class Callbacks(ctypes.Structure):
                _fields_ = (("pointers", ctypes.c_void_p * 4),)

            return self._keep(Callbacks.from_buffer_copy(pointers))
        return self._keep(pointers)

    def _keep(self, value: Any) -> Any:
        self.kept.append(value)
        return value

    # ---- the end ----

    def watch_over(self) -> None:
        """End the process when it has too much memory, or writes too much."""
        most, written = self.about["memory"], 0
        while True:
            time.sleep(_PERIOD)
            if resident() > most:
                self.end(MEMORY)
            with suppress(OSError):
                size = os.fstat(1).st_size
                if written + size > self.about["output"]:
                    self.end(OUTPUT)
                if size > _KEPT_OUTPUT:
                    os.truncate(self.about["printed"], 0)
                    written += size

    def end(self, cause: int) -> None:
        """End the process, with the reason for its parent."""
        self.words[CAUSE] = cause
        self.leave()

    def leave(self) -> None:
        """End the process, and those that the FMU has started; its host, or the host's keeper, removes its folder."""
        kill_group(self.about["group"])


def _bytes(text: str) -> bytes:
    return text.encode("latin-1")


def main() -> None:
    """Serve; the last argument says where the shared memory is."""
    about = json.loads(sys.argv[-1])
    commands, replies = move(0), move(1)
    print_to(about["printed"])
    child = Child(commands, replies, about)
    limit(about["memory"])
    if not has_room():
        child.end(NO_ROOM)
    threading.Thread(target=child.watch_over, daemon=True).start()
    child.serve()
