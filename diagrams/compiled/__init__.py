"""The compiled loop: C code of a diagram's ticks and of what happens between them, and the loops that run it."""

from .background import BackgroundCode
from .bound_functions import bind_call
from .compiled_libraries import load_compiled
from .compiled_loop import CompiledLoop, Outcome, ReturnReason
from .event_domains import Domains
from .exported_memory import NamedCode, function_text, read_memory
from .function_code import Code
from .fused import FusedPlant, compile_fused, fuse
from .grouping import make_tables
from .handed_over import HandedOver
from .hybrid import (
    BrokenOff,
    CompiledHybrid,
    HybridOutcome,
    HybridReason,
    Lost,
    MethodOptions,
    Sign,
    Span,
)
from .hybrid_code import (
    HybridCode,
    compile_hybrid,
    find_code_obstacle,
    hybrid_sources,
    interpret_hybrid,
    write_hybrid,
)
from .kernels import Kernel
from .library_method import StepFailure
from .newton import NewtonOptions
from .plants_called_back import REFUSED, TAKEN_BY_PYTHON, UNDER_WAY, PythonStep, compile_other_side
from .runtime import load_runtime
from .staged import NativeModelExchange, OwnEvent
from .tick_code import LARGEST, TickCode, compile_ticks, find_obstacle, interpret_ticks, write_ticks
from .transport_delays import Delays, delays_of
from .watch import Fired, Pile

__all__ = [
    "LARGEST",
    "REFUSED",
    "TAKEN_BY_PYTHON",
    "UNDER_WAY",
    "BackgroundCode",
    "BrokenOff",
    "Code",
    "CompiledHybrid",
    "CompiledLoop",
    "Delays",
    "Domains",
    "Fired",
    "FusedPlant",
    "HandedOver",
    "HybridCode",
    "HybridOutcome",
    "HybridReason",
    "Kernel",
    "Lost",
    "MethodOptions",
    "NamedCode",
    "NativeModelExchange",
    "NewtonOptions",
    "Outcome",
    "OwnEvent",
    "Pile",
    "PythonStep",
    "ReturnReason",
    "Sign",
    "Span",
    "StepFailure",
    "TickCode",
    "bind_call",
    "compile_fused",
    "compile_hybrid",
    "compile_other_side",
    "compile_ticks",
    "delays_of",
    "find_code_obstacle",
    "find_obstacle",
    "function_text",
    "fuse",
    "hybrid_sources",
    "interpret_hybrid",
    "interpret_ticks",
    "load_compiled",
    "load_runtime",
    "make_tables",
    "read_memory",
    "write_hybrid",
    "write_ticks",
]
