"""FMU files: their description, read and checked."""

from .description import FmuDescription, FmuVariable, OtherVariable, read_description

__all__ = [
    "FmuDescription",
    "FmuVariable",
    "OtherVariable",
    "read_description",
]
