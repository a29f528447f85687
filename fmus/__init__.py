"""FMUs: plants that are written as Python equations and exported, and FMUs of any tool as blocks."""

from .archive.description import FmuDescription, FmuVariable, read_description
from .calls.instance import FmuInstance, FmuState
from .export.build import build_fmu, clear_cache
from .export.from_block import build, model_spec
from .export.model import ModelSpec, Variable
from .export.python_fmu import build_python
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
from .running.fmu import Fmu
from .running.linearization import FmuLinearization

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
