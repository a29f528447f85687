"""Results of runs: recording, storage, plots and exports."""

from .memory import machine_memory
from .operating_point import FreeDirection, OperatingPoint, PointOrigin, units_of
from .recorder import Recorder, select
from .recording import Recording
from .run import Run, Snapshot
from .saved_state import RunState, check_fits, layout_of, not_open_error
from .signal_names import BlockOutputs, Places, entries, outputs_of, resolve
from .stored import Occurrence, Stopped
from .texts import TextSignal

__all__ = [
    "BlockOutputs",
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
    "Stopped",
    "TextSignal",
    "check_fits",
    "entries",
    "layout_of",
    "machine_memory",
    "not_open_error",
    "outputs_of",
    "resolve",
    "select",
    "units_of",
]
