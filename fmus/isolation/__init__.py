"""A child process that holds the library of an FMU: requests, shared memory, watchdog, end."""

from .endings import describe_memory
from .fmu_process import ChildProcess, ChildRequest
from .pool import count_processes, end_idle, give_back, take
from .printf import Logger, format_message
from .process_limits import Isolation, default_memory
from .wire import WATCH_TEXTS

__all__ = [
    "WATCH_TEXTS",
    "ChildProcess",
    "ChildRequest",
    "Isolation",
    "Logger",
    "count_processes",
    "default_memory",
    "describe_memory",
    "end_idle",
    "format_message",
    "give_back",
    "take",
]
