"""Linear models, operating points and trim."""

from .derivatives import Signal, find_signal
from .findings import (
    BlockFinding,
    CutFromTracking,
    EntryTaken,
    EventWithinPeriod,
    InertConsumer,
    Kink,
    MeanSlope,
    StepsOnly,
    UnusualStart,
    ZeroSlope,
)
from .kinks import find_kinks_between
from .linear_model import Linearization, linearize, linearize_batch
from .loops_over_a_period import ticks_to_renewal
from .operating_points import PointLike, capture, operating_point, run_to
from .trim_search import point_from_states, trim

__all__ = [
    "BlockFinding",
    "CutFromTracking",
    "EntryTaken",
    "EventWithinPeriod",
    "InertConsumer",
    "Kink",
    "Linearization",
    "MeanSlope",
    "PointLike",
    "Signal",
    "StepsOnly",
    "UnusualStart",
    "ZeroSlope",
    "capture",
    "find_kinks_between",
    "find_signal",
    "linearize",
    "linearize_batch",
    "operating_point",
    "point_from_states",
    "run_to",
    "ticks_to_renewal",
    "trim",
]
