"""FMU files: their description, read and checked."""

from .description import FmuDescription, read_description
from .variables import FmuVariable, OtherVariable, inexact

__all__ = [
    "FmuDescription",
    "FmuVariable",
    "OtherVariable",
    "inexact",
    "read_description",
]
