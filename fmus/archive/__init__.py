"""FMU files: their description, read and checked."""

from .description import FmuDescription, FmuVariable, read_description

__all__ = [
    "FmuDescription",
    "FmuVariable",
    "read_description",
]
