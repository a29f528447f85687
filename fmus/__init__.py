"""FMUs: plants written as Python equations and exported, and FMUs of anyone's as blocks."""

from . import (
    bouncing_ball,
    dc_motor,
    gantry,
    gantry_contact,
    gantry_elastic,
    gantry_stiction,
    mass_spring_damper,
    scara,
)
from ._build import build_fmu, clear_cache
from ._description_reading import FmuDescription, FmuVariable, read_description
from ._export import build, model_spec
from ._fmu import Fmu
from ._instance import FmuInstance, FmuState
from ._linearization import FmuLinearization
from ._pythonfmu import build_python
from ._spec import ModelSpec, Variable

__all__ = [
    "Fmu",
    "FmuDescription",
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
