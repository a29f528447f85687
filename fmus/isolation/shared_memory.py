"""Words and messages in the memory that this process shares with a child; it imports the standard library only.

A request is the number of a bound sequence, or `MAIL`: a message in the mailbox. Words are watched for a short while;
then their reader says that it sleeps, and is woken by a byte in its pipe.
"""

from __future__ import annotations

import json
import mmap
import os
import platform
import struct
import threading
from collections.abc import Sequence
from typing import Any

REQUEST, REPLY, CHILD_SLEEPS, PARENT_SLEEPS = 0, 8, 16, 24
"""Places of words, each in its own cache line: number of the last request and of the last reply, and flags."""
SEQUENCE, STATUS, PLACE, LENGTH, MESSAGES, CAUSE = 32, 33, 34, 35, 40, 48
"""Sequence to run; its status; call in work; length of the message; number of log messages; reason of the end."""
MAIL = 1 << 32
"""Word `SEQUENCE` of a message."""
MAILBOX, DATA = 512, 1 << 16
"""Bytes at which the message and the values begin."""
MEMORY, OUTPUT, NO_ROOM = 1, 2, 3
"""Reasons in the word `CAUSE`, for which the child has ended itself."""
WAKE = b"w"
WATCH_TEXTS = "loopwright_watch_texts"
"""Name of a call of the child's own among those that are bound; see `Child._watch_texts`."""
LOG_HEAD = struct.Struct("<iI")
"""Head of a log message in its file: status and length."""
LONGEST_MESSAGE, MOST_MESSAGES, MOST_LOGGED = 8192, 20000, 64_000_000
"""Most bytes of a message, messages in a call, and bytes of messages in a process; the others are left out."""

ORDERED = platform.machine().lower() in ("x86_64", "amd64", "i686")
"""Whether memory is written in the order of the program, so that words can be watched without barriers."""
_HEAD = struct.Struct("<II")
FEWEST, _RAREST = 4, 1024
ORDER = threading.Lock()


class Patience:
    """Number of looks at a word before its reader sleeps: all of them while watching is right, else none, and a trial.

    A look takes some 40 ns. Where the other side shares this core, or takes long, watching only takes time from it.
    `pause` is the number of readings until the next trial; the reader sets it to `FEWEST` whenever watching was right.
    """

    def __init__(self, looks: int, *, may: bool):
        self._looks, self.looks = looks if may else 0, 0
        self.pause = self._left = FEWEST

    def slept(self) -> None:
        """Note that the reader slept; after ever longer pauses watching is tried again."""
        if self.looks:
            self.looks, self._left = 0, self.pause
            self.pause = min(2 * self.pause, _RAREST)
        else:
            self._left -= 1
            if self._left <= 0:
                self.looks = self._looks


def order_memory() -> None:
    """Let earlier writes be seen before later reads are done: a lock's atomic operation is a full barrier on x86."""
    if ORDER.acquire(False):
        ORDER.release()


def write_message(memory: mmap.mmap, words: memoryview, file: str, message: Any, blobs: Sequence[bytes]) -> None:
    """Write a message that JSON can write, and bytes that go with it, to the mailbox; a long one goes to a file."""
    text = json.dumps([[len(b) for b in blobs], message]).encode()
    data = b"".join([_HEAD.pack(len(text), sum(map(len, blobs))), text, *blobs])
    words[LENGTH] = len(data)
    if len(data) <= DATA - MAILBOX:
        memory[MAILBOX : MAILBOX + len(data)] = data
        return
    with open(file, "wb") as mail:
        mail.write(data)


def read_message(memory: mmap.mmap, words: memoryview, file: str) -> tuple[Any, list[bytes]]:
    """Return the message in the mailbox, and its bytes."""
    n = words[LENGTH]
    if n <= DATA - MAILBOX:
        data = memory[MAILBOX : MAILBOX + n]
    else:
        with open(file, "rb") as mail:
            data = mail.read(n)
        os.unlink(file)
    size, _ = _HEAD.unpack_from(data)
    at = _HEAD.size + size
    sizes, message = json.loads(data[_HEAD.size : at])
    blobs = []
    for n in sizes:
        blobs.append(data[at : at + n])
        at += n
    return message, blobs
