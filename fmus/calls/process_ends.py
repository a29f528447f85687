"""Last words on the end of an FMU's process: its own messages, and the next step."""

from __future__ import annotations

from ...blocks.core import FmuEnd, FmuProcessError
from .message_log import clean_text

_RERUN = "Samples until then are in error.run. The FMU can be run again; other FMUs and this process go on."
_ADVICE = {
    FmuEnd.CRASH: f"{_RERUN} Report it to its makers.",
    FmuEnd.EXIT: f"{_RERUN} Report it to its makers: a library must not end its process.",
    FmuEnd.TIMEOUT: "It may wait for a licence or another program, or hang. Give it more time by "
    f"isolate=Isolation(step_time=…, start_time=…), or take a smaller step. {_RERUN}",
    FmuEnd.MEMORY: f"Give it more by isolate=Isolation(memory=…), if it needs that much. {_RERUN}",
    FmuEnd.OUTPUT: f"Let it log less, or give it more by isolate=Isolation(output=…). {_RERUN}",
    FmuEnd.LOST: _RERUN,
}
"""Next step after the end of an FMU's process."""


def describe_end(error: FmuProcessError, said: str) -> str:
    """Return the text that follows the cause: messages of the FMU (``said``), lines that it printed, the next step."""
    return f"{said.removeprefix('.')}{clean_text(error.printed)} {_ADVICE[error.cause]}"
