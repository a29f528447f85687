"""Plants of the library."""

from .gantry import Gantry

__all__ = [
    "Gantry",
]
