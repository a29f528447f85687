"""The compiled loop: C code of a diagram's ticks and of what happens between them, and the loops that run it."""

from .background import BackgroundCode
from .bound_functions import bind_call
from .compiled_libraries import load_compiled, load_runtime
from .diagram_code import (
    DiagramCode,
    code_sources,
    compile_code,
    find_obstacle,
    functions_between,
    interpret_code,
    write_code,
)
from .event_domains import Domains
from .events_in_c import Pile
from .expanded_functions import LARGEST, ExpandedFunctions
from .exported_memory import NamedCode, function_text, read_memory
from .fused import FusedPlant, compile_fused, fuse
from .grouping import make_tables
from .integration_methods import MethodOptions, StepFailure
from .kernels import Kernel
from .loop_over_ticks import CompiledLoop, Outcome, ReturnReason
from .loop_over_time import (
    BrokenOff,
    CompiledHybrid,
    Lost,
    Sign,
    Span,
)
from .model_exchange_in_c import ModelExchangeHandOver, NativeModelExchange
from .newton import NewtonOptions
from .plants_called_back import REFUSED, TAKEN_BY_PYTHON, UNDER_WAY, PythonStep, compile_other_side
from .transport_delays import Delays, delays_of

__all__ = [
    "LARGEST",
    "REFUSED",
    "TAKEN_BY_PYTHON",
    "UNDER_WAY",
    "BackgroundCode",
    "BrokenOff",
    "CompiledHybrid",
    "CompiledLoop",
    "Delays",
    "DiagramCode",
    "Domains",
    "ExpandedFunctions",
    "FusedPlant",
    "Kernel",
    "Lost",
    "MethodOptions",
    "ModelExchangeHandOver",
    "NamedCode",
    "NativeModelExchange",
    "NewtonOptions",
    "Outcome",
    "Pile",
    "PythonStep",
    "ReturnReason",
    "Sign",
    "Span",
    "StepFailure",
    "bind_call",
    "code_sources",
    "compile_code",
    "compile_fused",
    "compile_other_side",
    "delays_of",
    "find_obstacle",
    "function_text",
    "functions_between",
    "fuse",
    "interpret_code",
    "load_compiled",
    "load_runtime",
    "make_tables",
    "read_memory",
    "write_code",
]
