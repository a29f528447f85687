"""Child processes that end with this process, however it ends."""

from .group import ProcessGroup, run_in_group

__all__ = ["ProcessGroup", "run_in_group"]
