"""Sweeps: runs of a diagram with many values of its parameters, and studies over ranges of them."""

from .outcome import Failure
from .processes import processors, to_bytes
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
    "grid",
    "latin",
    "maximum",
    "mean",
    "minimum",
    "processors",
    "read_samples",
    "settling_time",
    "sweep",
    "table",
    "to_bytes",
]
