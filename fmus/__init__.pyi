from .archive import ArchiveLimits, FmuDescription, FmuFault, FmuFinding, FmuSeverity, FmuVariable, read_description
from .calls import FmuInstance, FmuState, StepOptions, StepTime
from .checks import FmuDiagnosis, FmuTrial, FmuVerdict, doctor
from .export import ModelSpec, Variable, build, build_fmu, build_python, clear_cache, model_spec, tune
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
from .running import Fmu, FmuLinearization

__all__ = [
    "ArchiveLimits",
    "Fmu",
    "FmuDescription",
    "FmuDiagnosis",
    "FmuFault",
    "FmuFinding",
    "FmuInstance",
    "FmuLinearization",
    "FmuSeverity",
    "FmuState",
    "FmuTrial",
    "FmuVariable",
    "FmuVerdict",
    "Isolation",
    "ModelSpec",
    "StepOptions",
    "StepTime",
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
