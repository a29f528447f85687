"""SSP, the Modelica Association's format of systems of FMUs: read into diagrams, and written from them."""

from .reading import SspDescription, read_ssp, read_structure
from .writing import write_ssp

__all__ = [
    "SspDescription",
    "read_ssp",
    "read_structure",
    "write_ssp",
]
