from ..blocks.core import (
    CompilerError,
    DefinitionError,
    DiskError,
    FmuError,
    FmuFileError,
    FmuProcessError,
    FmuRuntimeError,
    OptionError,
    ParameterError,
    UnitError,
    UnknownNameError,
)
from .archive import ArchiveLimits, read_description
from .calls import StepOptions, StepTime
from .checks import doctor
from .export import ModelSpec, Variable, build, build_fmu, build_python, clear_cache, model_spec, tune
from .fmu_block import Fmu
from .isolation import Isolation
from .models import (
    bouncing_ball,
    dc_motor,
    gantry,
    gantry_contact,
    gantry_elastic,
    gantry_stiction,
    mass_spring_damper,
    scara,
)

__all__ = [
    "ArchiveLimits",
    "CompilerError",
    "DefinitionError",
    "DiskError",
    "Fmu",
    "FmuError",
    "FmuFileError",
    "FmuProcessError",
    "FmuRuntimeError",
    "Isolation",
    "ModelSpec",
    "OptionError",
    "ParameterError",
    "StepOptions",
    "StepTime",
    "UnitError",
    "UnknownNameError",
    "Variable",
    "bouncing_ball",
    "build",
    "build_fmu",
    "build_python",
    "clear_cache",
    "dc_motor",
    "doctor",
    "gantry",
    "gantry_contact",
    "gantry_elastic",
    "gantry_stiction",
    "mass_spring_damper",
    "model_spec",
    "read_description",
    "scara",
    "tune",
]
