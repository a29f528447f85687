"""FMI calls into a library that is loaded in this process."""

from .exchange_instance import ExchangeInstance, is_smooth
from .fmi2 import Fmi2Calls
from .fmi3 import Fmi3Calls
from .fmi_calls import BoundCalls, Call, FmiCalls, Log
from .fmu_block import FmuBlock
from .instance import FmuInstance, FmuState
from .loaded_library import LoadedFmu, MakeCalls
from .step_options import StepOptions, StepTime, check_offered

__all__ = [
    "BoundCalls",
    "Call",
    "ExchangeInstance",
    "Fmi2Calls",
    "Fmi3Calls",
    "FmiCalls",
    "FmuBlock",
    "FmuInstance",
    "FmuState",
    "LoadedFmu",
    "Log",
    "MakeCalls",
    "StepOptions",
    "StepTime",
    "check_offered",
    "is_smooth",
]
