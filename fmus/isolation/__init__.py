"""FMUs in their own processes: the face of `fmus/calls`, with the library in a child."""

from .opening import find_limits, open_fmu
from .pool import count_processes, end_idle
from .process_limits import Isolation

__all__ = [
    "Isolation",
    "count_processes",
    "end_idle",
    "find_limits",
    "open_fmu",
]
