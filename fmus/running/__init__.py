"""The block `Fmu` and its linear model."""

from .derivation import Derivation, DerivativeMethod
from .exchange import find_exchange_slopes
from .fmu import Fmu
from .known_models import linearize_fmu
from .linearization import FmuLinearization
from .restored_point import RestoredPoint

__all__ = [
    "Derivation",
    "DerivativeMethod",
    "Fmu",
    "FmuLinearization",
    "RestoredPoint",
    "find_exchange_slopes",
    "linearize_fmu",
]
