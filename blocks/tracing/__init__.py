"""Equations of blocks as CasADi functions, and their discretization."""

from .computed import trace_initial, trace_numbers
from .differences import differentiate, extrapolate
from .discretization import METHOD, check_method, find_hold, hold
from .equations import initial_state, is_only_sampled, start_shapes, start_values, state_after_start
from .model_exchange import describe_model_exchange
from .numpy_check import GUARDS, NEXT, Columns, Point, Values, evaluate
from .opaque_equations import raise_failure
from .structure import has_structure, is_traced_by, traced_parameters
from .switching_times import Line, switching_times
from .symbols import (
    MATH_FUNCTIONS,
    bundle,
    count_uses,
    flat_column,
    has_large_product,
    is_nonzero,
    size,
    with_values,
    wrap,
)
from .traced import Traced, constants_of, trace
from .traced_array import as_traced

__all__ = [
    "GUARDS",
    "MATH_FUNCTIONS",
    "METHOD",
    "NEXT",
    "Columns",
    "Line",
    "Point",
    "Traced",
    "Values",
    "as_traced",
    "bundle",
    "check_method",
    "constants_of",
    "count_uses",
    "describe_model_exchange",
    "differentiate",
    "evaluate",
    "extrapolate",
    "find_hold",
    "flat_column",
    "has_large_product",
    "has_structure",
    "hold",
    "initial_state",
    "is_nonzero",
    "is_only_sampled",
    "is_traced_by",
    "raise_failure",
    "size",
    "start_shapes",
    "start_values",
    "state_after_start",
    "switching_times",
    "trace",
    "trace_initial",
    "trace_numbers",
    "traced_parameters",
    "with_values",
    "wrap",
]
