"""Sweeps: runs of a diagram with many values of its parameters, and studies over ranges of them."""

from .names import find_parameter
from .outcome import Failure
from .reductions import Reduction, final, maximum, mean, minimum, settling_time
from .result import Sweep
from .samples import Box, Sample, Samples, grid, latin, read_samples, table
from .sweep import InterruptedSweep, sweep

__all__ = [
    "Box",
    "Failure",
    "InterruptedSweep",
    "Reduction",
    "Sample",
    "Samples",
    "Sweep",
    "final",
    "find_parameter",
    "grid",
    "latin",
    "maximum",
    "mean",
    "minimum",
    "read_samples",
    "settling_time",
    "sweep",
    "table",
]
