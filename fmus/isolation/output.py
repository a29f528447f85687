"""Log messages and standard output of an FMU in a child, which are files in its folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from .wire import LOG_HEAD

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
