"""FMI calls into a library that is loaded in this process or in another one."""

from .bound_calls import BoundCalls
from .fmi_calls import ERROR, WARNING
from .instance import FmuInstance
from .library_functions import LibraryFunctions, list_prototypes
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
    "FmuInstance",
    "FmuSetup",
    "FmuState",
    "LibraryFunctions",
    "LoadedFmu",
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
    "is_kept",
    "is_smooth",
    "list_prototypes",
]
