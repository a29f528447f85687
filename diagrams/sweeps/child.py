"""Worker process of a sweep: it reads a plan and samples from its standard input, and answers with outcomes."""

from __future__ import annotations

import os
import pickle
import signal
import struct
import sys
from typing import Any, BinaryIO

_HEAD = struct.Struct("<Q")


def send(file: BinaryIO, message: object) -> None:
    """Write a message: its length, then its bytes."""
    data = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
    file.write(_HEAD.pack(len(data)))
    file.write(data)
    file.flush()


def receive(file: BinaryIO) -> Any:
    """Read a message.

    Raises
    ------
    EOFError
        If the other side has ended.
    """
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        raise EOFError
    (size,) = _HEAD.unpack(head)
    data = file.read(size)
    if len(data) < size:
        raise EOFError
    return pickle.loads(data)


def main() -> None:
    """Answer samples until the standard input ends; what anybody prints goes to the standard error."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # its parent process decides when it ends
    if hasattr(signal, "SIGTTOU"):  # it is no foreground process, and may write to any terminal all the same
        signal.signal(signal.SIGTTOU, signal.SIG_IGN)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    orders = sys.stdin.buffer
    try:
        sys.path[:] = receive(orders)
        plan = pickle.loads(receive(orders))
    except EOFError:
        return
    except Exception as error:
        send(answers, error_text(error))
        return
    from ...blocks.core import one_thread
    from ...fmus.child_processes import end_all
    from .workers import make_worker

    try:
        with one_thread(), make_worker(plan) as worker:
            send(answers, "")
            while True:
                try:
                    sample = receive(orders)
                except EOFError:
                    return
                for outcome in worker.run_all([sample]):
                    send(answers, outcome)
    finally:
        end_all()


def error_text(error: BaseException) -> str:
    """Return an error with its class."""
    return f"{type(error).__name__}: {error}"
