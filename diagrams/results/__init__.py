"""Results of runs: recording, storage, plots and exports."""

from .memory import machine_memory
from .operating_point import FreeDirection, OperatingPoint, PointOrigin, units_of
from .recorded_texts import TextSignal
from .recorder import Recorder, select
from .recording import Recording
from .run import Run, Snapshot
from .saved_state import RunState, check_fits, layout_of, not_open_error
from .signal_names import Places, entries, outputs_of, resolve
from .step_info import StepInfo
from .step_measures import ExpectedStep, is_at_rest, measure_step
from .stored import Occurrence, Stopped

__all__ = [
    "ExpectedStep",
    "FreeDirection",
    "Occurrence",
    "OperatingPoint",
    "Places",
    "PointOrigin",
    "Recorder",
    "Recording",
    "Run",
    "RunState",
    "Snapshot",
    "StepInfo",
    "Stopped",
    "TextSignal",
    "check_fits",
    "entries",
    "is_at_rest",
    "layout_of",
    "machine_memory",
    "measure_step",
    "not_open_error",
    "outputs_of",
    "resolve",
    "select",
    "units_of",
]
