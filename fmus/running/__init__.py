"""The block `Fmu` and its linear model."""

from .derivation import Derivation, DerivativeMethod
from .exchange import find_exchange_slopes
from .fmu import Fmu
from .linearization import FmuLinearization

__all__ = [
    "Derivation",
    "DerivativeMethod",
    "Fmu",
    "FmuLinearization",
    "find_exchange_slopes",
]
