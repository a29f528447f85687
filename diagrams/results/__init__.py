"""Results of runs: recording, storage, plots and exports."""

from .operating_point import FreeDirection, OperatingPoint, PointOrigin, units_of
from .recorded_signals import RecordedSignals
from .recorded_texts import TextSignal
from .recorder import Recorder, Recording, machine_memory
from .run import Run, Snapshot
from .saved_state import RunState, check_fits, layout_of, not_open_error
from .signal_names import explain_input, resolve
from .step_info import ExpectedStep, StepInfo, is_at_rest, measure_step
from .stored import SWEEP_HEADER, Occurrence, Stopped

__all__ = [
    "SWEEP_HEADER",
    "ExpectedStep",
    "FreeDirection",
    "Occurrence",
    "OperatingPoint",
    "PointOrigin",
    "RecordedSignals",
    "Recorder",
    "Recording",
    "Run",
    "RunState",
    "Snapshot",
    "StepInfo",
    "Stopped",
    "TextSignal",
    "check_fits",
    "explain_input",
    "is_at_rest",
    "layout_of",
    "machine_memory",
    "measure_step",
    "not_open_error",
    "resolve",
    "units_of",
]
