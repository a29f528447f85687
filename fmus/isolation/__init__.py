"""A child process that holds the library of an FMU: requests, shared memory, watchdog, end."""

from .callbacks import InputLines, log_and_memory
from .end_reasons import describe_memory
from .fmu_process import ChildProcess, ChildRequest
from .pool import count_processes, end_idle, give_back, take
from .process_limits import Isolation, default_memory
from .shared_memory import WATCH_TEXTS

__all__ = [
    "WATCH_TEXTS",
    "ChildProcess",
    "ChildRequest",
    "InputLines",
    "Isolation",
    "count_processes",
    "default_memory",
    "describe_memory",
    "end_idle",
    "give_back",
    "log_and_memory",
    "take",
]
