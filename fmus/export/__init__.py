"""Export of a block as an FMU: equations, C code, model description, binaries."""

from .compiler import compile_shared, describe_compiler
from .from_block import build, model_spec
from .inlined import inline_model, own_functions
from .model import Integrator, ModelSpec, Variable
from .package import build_fmu, clear_cache
from .python_fmu import build_python
from .tuning import describe_processor, processor_flags, tune
from .written_equations import WrittenEquations, read_equations

__all__ = [
    "Integrator",
    "ModelSpec",
    "Variable",
    "WrittenEquations",
    "build",
    "build_fmu",
    "build_python",
    "clear_cache",
    "compile_shared",
    "describe_compiler",
    "describe_processor",
    "inline_model",
    "model_spec",
    "own_functions",
    "processor_flags",
    "read_equations",
    "tune",
]
