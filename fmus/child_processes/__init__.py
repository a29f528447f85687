"""Child processes and temporary folders that end with this process, however it ends."""

from .folders import folder_in, make_temporary_folder, remove_folder, temporary_folder
from .group import ProcessGroup, run_in_group
from .keeper import end_all, find_python

__all__ = [
    "ProcessGroup",
    "end_all",
    "find_python",
    "folder_in",
    "make_temporary_folder",
    "remove_folder",
    "run_in_group",
    "temporary_folder",
]
