"""The block `Fmu` and its linear model."""

from .derivation import Derivation, DerivativeMethod
from .equation_slopes import EquationSlopes, LocalEquations
from .fmu import Fmu, setup_of
from .fmu_point import FmuLinearization, open_to_step, refuse_end, take_step
from .known_models import linearize_fmu, step_gap
from .replacement import suggest_names
from .restored_point import RestoredPoint
from .shifted_steps import take_shifted_steps

__all__ = [
    "Derivation",
    "DerivativeMethod",
    "EquationSlopes",
    "Fmu",
    "FmuLinearization",
    "LocalEquations",
    "RestoredPoint",
    "linearize_fmu",
    "open_to_step",
    "refuse_end",
    "setup_of",
    "step_gap",
    "suggest_names",
    "take_shifted_steps",
    "take_step",
]
