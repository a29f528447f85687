"""Child processes that run a function of ours: both sides exchange pickled messages over standard input and output."""

from __future__ import annotations

import os
import pickle
import signal
import struct
import subprocess
import sys
from contextlib import suppress
from typing import IO, Any

from .group import ProcessGroup
from .keeper import find_python

_HEAD = struct.Struct("<Q")


class _Messages:
    """Messages to and from another process, each of them its length and its bytes."""

    def __init__(self, incoming: IO[bytes] | None, outgoing: IO[bytes] | None):
        assert incoming is not None
        assert outgoing is not None
        self._incoming, self._outgoing = incoming, outgoing

    def send(self, message: object) -> None:
        """Send a message; an `OSError` if the other side has ended."""
        data = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
        self._outgoing.write(_HEAD.pack(len(data)))
        self._outgoing.write(data)
        self._outgoing.flush()

    def receive(self) -> Any:
        """Wait for a message; an `EOFError` if the other side has ended."""
        head = self._incoming.read(_HEAD.size)
        if len(head) < _HEAD.size:
            raise EOFError
        (size,) = _HEAD.unpack(head)
        data = self._incoming.read(size)
        if len(data) < size:
            raise EOFError
        return pickle.loads(data)


class PythonChild(_Messages):
    """A child process that runs the function ``main`` of a module, which makes a `Host` first, seen from this one.

    An `OSError` says that it can't be started.
    """

    def __init__(self, group: ProcessGroup, module: str):
        program = [find_python(), "-c", f"from {module} import main; main()"]
        self._process = group.start(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        super().__init__(self._process.stdout, self._process.stdin)
        with suppress(OSError):  # it has ended: what is sent or received next shows it
            self.send(sys.path)

    def has_ended(self) -> bool:
        """Return whether it has ended."""
        return self._process.poll() is not None

    def leave(self, seconds: float) -> None:
        """Let it end by itself, within a time in s."""
        with suppress(OSError, subprocess.TimeoutExpired):
            self._outgoing.close()
            self._process.wait(seconds)

    def kill(self) -> None:
        """End it, whatever it does: a thread that waits for a message sees its end."""
        self._process.kill()
        self._process.wait()

    def wait(self) -> int:
        """Hear no more of it, and wait for its end; return its exit status, of a signal its negative number."""
        for pipe in (self._outgoing, self._incoming):
            with suppress(OSError):
                pipe.close()
        return self._process.wait()


class Host(_Messages):
    """The process that has started this one, as the function of this one sees it.

    It takes standard input and output for the messages: what anybody prints goes to the standard error. Ctrl-C is left
    to the host. An `EOFError` says that the host has ended.
    """

    def __init__(self) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the host decides when this process ends
        if hasattr(signal, "SIGTTOU"):  # it is no foreground process, and may write to any terminal all the same
            signal.signal(signal.SIGTTOU, signal.SIG_IGN)
        answers = os.fdopen(os.dup(1), "wb")
        os.dup2(2, 1)
        super().__init__(sys.stdin.buffer, answers)
        sys.path[:] = self.receive()
