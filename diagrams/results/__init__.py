"""Results of runs: recording, storage, plots and exports."""

from .layout import lay_out
from .memory import machine_memory
from .operating_point import FreeDirection, OperatingPoint, PointOrigin, units_of
from .plots import (
    BLUE,
    DARK,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    STONE,
    VERMILION,
    WIDTH,
    legend_above,
    limit_time,
    marker_of,
    new_figure,
    save,
    style,
)
from .recorder import Recorder, select
from .recording import Recording
from .run import Run, Snapshot
from .saved_state import RunState, check_fits, layout_of, not_open_error
from .signal_names import Places, entries, resolve
from .stored import Occurrence, Stopped
from .texts import TextSignal

__all__ = [
    "BLUE",
    "DARK",
    "GREEN",
    "GREY",
    "ORANGE",
    "PURPLE",
    "STONE",
    "VERMILION",
    "WIDTH",
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
    "lay_out",
    "layout_of",
    "legend_above",
    "limit_time",
    "machine_memory",
    "marker_of",
    "new_figure",
    "not_open_error",
    "resolve",
    "save",
    "select",
    "style",
    "units_of",
]
