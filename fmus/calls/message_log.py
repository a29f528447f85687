"""Log of an instance: messages of the FMU and notes on it, cleaned and within bounds; last words on its end."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from ...blocks.core import FmuEnd, FmuProcessError
from .fmi_calls import STATUS

_MOST_MESSAGES = 1000
"""Most different messages of an FMU that are kept."""
_LONGEST = 2000
"""Most characters of a message that are kept."""
_QUOTED = 5

_RERUN = "Samples until then are in error.run. The FMU can be run again; other FMUs and this process continue."
_ADVICE = {
    FmuEnd.CRASH: f"{_RERUN} Report it to its makers.",
    FmuEnd.KILLED: "The system does so where memory is short, and its log says so (dmesg); another program may, too. "
    f"Free some memory, or run fewer FMUs at once. {_RERUN}",
    FmuEnd.EXIT: f"{_RERUN} Report it to its makers: a library must not end its process.",
    FmuEnd.TIMEOUT: "It may wait for a licence or another program, or hang. Give it more time by "
    f"isolate=Isolation(step_time=…, start_time=…), or take a smaller step. {_RERUN}",
    FmuEnd.MEMORY: f"Give it more by isolate=Isolation(memory=…), if it needs that much. {_RERUN}",
    FmuEnd.OUTPUT: f"Let it log less, or give it more by isolate=Isolation(output=…). {_RERUN}",
    FmuEnd.LOST: _RERUN,
}
"""Next step after the end of an FMU's process."""


class MessageLog:
    """Messages of an FMU, each reported once with its count, after notes on the FMU; ``label`` names the block."""

    def __init__(self, label: str, notes: Iterable[str] = ()):
        self._label, self._notes = label, list(notes)
        self._lasting: int | None = None
        self._said: dict[str, int] = {}
        self._last: deque[str] = deque(maxlen=_QUOTED)
        self._left_out = 0
        self._warned = set[str]()

    def note(self, text: str) -> None:
        """Add a note, which is not the FMU's own."""
        self._notes.append(f"{self._label}: {text}")

    def begin_again(self) -> None:
        """Forget all but the notes that were there at the first call: another run begins, and reports its own."""
        if self._lasting is None:
            self._lasting = len(self._notes)
        del self._notes[self._lasting :]
        self._said, self._left_out = {}, 0
        self._last.clear()
        self._warned.clear()

    def warn(self, action: str, status: str, t: float) -> None:
        """Note a call that gave a warning, with the FMU's last words: the first time that an action does."""
        if action not in self._warned:
            self._warned.add(action)
            self.note(f"{action} gave {status} at t = {t:.9g} s; further ones are not reported{self.quote()}")

    def take(self, status: int, text: str) -> None:
        """Take a message of the FMU, of a status that is a warning or worse."""
        if not status:
            return
        kind = STATUS[status] if 0 <= status < len(STATUS) else f"status {status}"
        message = f"{self._label}: {kind}: {clean_text(text)}"
        if message not in self._last:
            self._last.append(message)
        if message in self._said or len(self._said) < _MOST_MESSAGES:
            self._said[message] = self._said.get(message, 0) + 1
        else:
            self._left_out += 1

    @property
    def texts(self) -> list[str]:
        """Notes, then the FMU's messages in the order in which each came first."""
        said = [m if n == 1 else f"{m} (said {n:,} times)" for m, n in self._said.items()]
        more = [f"{self._label}: {self._left_out:,} further messages are left out"] if self._left_out else []
        return [*self._notes, *said, *more]

    def quote(self) -> str:
        """Return the end of a sentence, with the FMU's last words if there are any."""
        return f". The FMU says: {' / '.join(m.rstrip('.') for m in self._last)}." if self._last else "."


def clean_text(text: str) -> str:
    r"""Return a text of an FMU on one line, without characters that steer a terminal, cut where it is very long.

    Examples
    --------
    >>> clean_text("no root\n  at t = 2\x1b[2J")
    'no root / at t = 2\\x1b[2J'
    """
    if len(text) > _LONGEST:
        text = f"{text[:_LONGEST]} … ({len(text):,} characters)"
    if text.isprintable():
        return text
    line = " / ".join(part.strip() for part in text.splitlines() if part.strip()).replace("\t", " ")
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in line)


def describe_end(error: FmuProcessError, said: str) -> str:
    """Return the text that follows the cause: messages of the FMU (``said``), lines that it printed, the next step."""
    return f"{said.removeprefix('.')}{clean_text(error.printed)} {_ADVICE[error.cause]}"
