"""FMUs in processes of their own: the face of `fmus/calls`, with the library in a child."""

from .opening import open_fmu

__all__ = [
    "open_fmu",
]
