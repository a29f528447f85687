from .blocks.core import OptionError, SimulationError, UnknownNameError
from .diagrams.sweeps import (
    Box,
    Failure,
    InterruptedSweep,
    Reduction,
    Sample,
    Samples,
    Sweep,
    final,
    maximum,
    mean,
    minimum,
    settling_time,
)

__all__ = [
    "Box",
    "Failure",
    "InterruptedSweep",
    "OptionError",
    "Reduction",
    "Sample",
    "Samples",
    "SimulationError",
    "Sweep",
    "UnknownNameError",
    "final",
    "maximum",
    "mean",
    "minimum",
    "settling_time",
]
