"""Sweeps: runs of a diagram with many values of its parameters, and studies over ranges of them."""

from .names import find_parameter
from .samples import Box, Sample, Samples, grid, latin, read_samples, table

__all__ = [
    "Box",
    "Sample",
    "Samples",
    "find_parameter",
    "grid",
    "latin",
    "read_samples",
    "table",
]
