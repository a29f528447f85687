"""Linear models, operating points and trim."""

from .derivatives import Signal, find_signal
from .findings import StepsOnly, UnusualStart
from .linear_model import Linearization, batch, linearize
from .loops_over_a_period import ticks_to_renewal
from .operating_points import at_time, capture, operating_point
from .trim_search import given, trim

__all__ = [
    "Linearization",
    "Signal",
    "StepsOnly",
    "UnusualStart",
    "at_time",
    "batch",
    "capture",
    "find_signal",
    "given",
    "linearize",
    "operating_point",
    "ticks_to_renewal",
    "trim",
]
