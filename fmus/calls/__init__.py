"""FMI calls into a library that is loaded in this process."""

from .fmu_block import FmuBlock
from .instance import FmuInstance, FmuState
from .loaded_library import LoadedFmu

__all__ = [
    "FmuBlock",
    "FmuInstance",
    "FmuState",
    "LoadedFmu",
]
