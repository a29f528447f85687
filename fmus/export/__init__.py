"""Export of a block as an FMU: equations, C code, model description, binaries."""

from .c_text import c_number, unit_name
from .compiler import compile_shared, compile_webassembly, describe_compiler
from .fmu_package import build_fmu, clear_cache
from .from_block import build, model_spec, parameter_variable
from .loop_memory import Field, LoopMemory
from .loop_spec import ROOM_FOR_EDGES, CFunction, ComputedNumbers, Guards, LoopSlopes, LoopSpec, Placed, write_unit
from .merged_plants import MergedPlant, PlacedPlant
from .model_spec import INTEGRATORS, Integrator, ModelSpec, Variable, check_ascii
from .own_sources import inline_model, own_functions, read_own_sources
from .python_fmu import build_python
from .scalar_operations import split_lookups
from .target_code import write_target
from .target_files import TargetCode, write_c
from .target_measure import ProcessorMeasurement, TargetMeasurement, measure, run_here
from .target_members import Number
from .target_spec import CLOCK_LIMIT, BlockOutput, Kept, TargetNumbers, TargetSpec, TargetTick
from .tick_text import TickFacts
from .tuning import describe_processor, processor_flags, tune
from .written_equations import WrittenEquations, read_equations

__all__ = [
    "CLOCK_LIMIT",
    "INTEGRATORS",
    "ROOM_FOR_EDGES",
    "BlockOutput",
    "CFunction",
    "ComputedNumbers",
    "Field",
    "Guards",
    "Integrator",
    "Kept",
    "LoopMemory",
    "LoopSlopes",
    "LoopSpec",
    "MergedPlant",
    "ModelSpec",
    "Number",
    "Placed",
    "PlacedPlant",
    "ProcessorMeasurement",
    "TargetCode",
    "TargetMeasurement",
    "TargetNumbers",
    "TargetSpec",
    "TargetTick",
    "TickFacts",
    "Variable",
    "WrittenEquations",
    "build",
    "build_fmu",
    "build_python",
    "c_number",
    "check_ascii",
    "clear_cache",
    "compile_shared",
    "compile_webassembly",
    "describe_compiler",
    "describe_processor",
    "inline_model",
    "measure",
    "model_spec",
    "own_functions",
    "parameter_variable",
    "processor_flags",
    "read_equations",
    "read_own_sources",
    "run_here",
    "split_lookups",
    "tune",
    "unit_name",
    "write_c",
    "write_target",
    "write_unit",
]
