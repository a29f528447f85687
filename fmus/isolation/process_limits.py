"""Limits of a process that an FMU runs in."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields

from ...blocks.core import ParameterError, accepts, explain_calls, kinds


@explain_calls
@accepts(
    "isolate",
    ParameterError,
    step_time=kinds.above_zero,
    start_time=kinds.above_zero,
    memory=kinds.above_zero,
    output=kinds.above_zero,
)
@dataclass(frozen=True)
class Isolation:
    """Limits of a process that an FMU runs in; a call beyond one ends the process, and the run with an error."""

    step_time: float = 60.0
    """Longest time of a call in s, other than those of the initialization."""
    start_time: float = 300.0
    """Longest time of a call in s while the FMU is loaded and initialized."""
    memory: float | None = None
    """Most memory of the process in bytes; None for three quarters of the machine's.

    The system enforces it on Linux; elsewhere the process looks at its memory four times a second.
    """
    output: float = 256e6
    """Most bytes that the FMU may write to its standard output and standard error in one process."""

    def __repr__(self) -> str:
        changed = (f for f in fields(self) if getattr(self, f.name) != f.default)
        return f"Isolation({', '.join(f'{f.name}={getattr(self, f.name)!r}' for f in changed)})"


def default_memory() -> float:
    """Return three quarters of the machine's memory in bytes; 16 GB where it isn't known."""
    try:
        return 0.75 * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return 16e9
