"""FMI calls into a library that is loaded in this process or in another one."""

from .bound_calls import BoundCalls, Call
from .fmi_calls import ERROR, WARNING, FmiCalls, Log
from .instance import FmuInstance
from .library_functions import LibraryFunctions, exported_name, list_prototypes
from .loaded_fmu import LoadedFmu
from .loading import FmuSetup
from .model_exchange_instance import ModelExchangeInstance
from .model_structure import is_smooth
from .native_calls import NativeAction, NativeLook, NativeStep, QuietStep, RemoteStep, SharedValues
from .saved_state import FmuState
from .step_options import StepOptions, StepTime, check_offered
from .step_outcome import NEAR
from .transfer import is_kept

__all__ = [
    "ERROR",
    "NEAR",
    "WARNING",
    "BoundCalls",
    "Call",
    "FmiCalls",
    "FmuInstance",
    "FmuSetup",
    "FmuState",
    "LibraryFunctions",
    "LoadedFmu",
    "Log",
    "ModelExchangeInstance",
    "NativeAction",
    "NativeLook",
    "NativeStep",
    "QuietStep",
    "RemoteStep",
    "SharedValues",
    "StepOptions",
    "StepTime",
    "check_offered",
    "exported_name",
    "is_kept",
    "is_smooth",
    "list_prototypes",
]
