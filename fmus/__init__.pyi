from .archive import ArchiveLimits, FmuDescription, FmuFault, FmuFinding, FmuVariable, read_description
from .calls import FmuInstance, FmuState
from .export import ModelSpec, Variable, build, build_fmu, build_python, clear_cache, model_spec
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
    "FmuFault",
    "FmuFinding",
    "FmuInstance",
    "FmuLinearization",
    "FmuState",
    "FmuVariable",
    "ModelSpec",
    "Variable",
    "bouncing_ball",
    "build",
    "build_fmu",
    "build_python",
    "clear_cache",
    "dc_motor",
    "gantry",
    "gantry_contact",
    "gantry_elastic",
    "gantry_stiction",
    "mass_spring_damper",
    "model_spec",
    "read_description",
    "scara",
]
