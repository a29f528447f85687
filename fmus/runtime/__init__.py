"""The loop over ticks and time in C, which knows no diagram: its sources, and the library of an installation."""

from .c_files import installed_runtime, read_sources, runtime_source

__all__ = ["installed_runtime", "read_sources", "runtime_source"]
