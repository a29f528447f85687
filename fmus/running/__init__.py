"""The block `Fmu` and its linear model."""

from .derivation import Derivation, DerivativeMethod
from .fmu import Fmu
from .linearization import FmuLinearization

__all__ = [
    "Derivation",
    "DerivativeMethod",
    "Fmu",
    "FmuLinearization",
]
