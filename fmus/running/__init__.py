"""The block `Fmu` and its linear model."""

from .derivation import Derivation, DerivativeMethod
from .fmu import Fmu
from .fmu_point import FmuLinearization
from .known_models import linearize_fmu, step_gap
from .linearization import check_exchange_slopes, find_exchange_slopes
from .replacement import suggest_names
from .restored_point import RestoredPoint
from .shifted_steps import take_shifted_steps

__all__ = [
    "Derivation",
    "DerivativeMethod",
    "Fmu",
    "FmuLinearization",
    "RestoredPoint",
    "check_exchange_slopes",
    "find_exchange_slopes",
    "linearize_fmu",
    "step_gap",
    "suggest_names",
    "take_shifted_steps",
]
