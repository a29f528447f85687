"""Child processes and temporary folders that end with this process, however it ends."""

from .folders import folder_in, make_temporary_folder, remove_folder, temporary_folder
from .group import ProcessGroup, run_in_group
from .keeper import end_all, find_python
from .python_child import Host, PythonChild

__all__ = [
    "Host",
    "ProcessGroup",
    "PythonChild",
    "end_all",
    "find_python",
    "folder_in",
    "make_temporary_folder",
    "remove_folder",
    "run_in_group",
    "temporary_folder",
]
