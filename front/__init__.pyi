from . import blocks, diagrams, fmus, frequency, sweeps, types
from .blocks import Block, Event, Input, LoopwrightError, Output, State, hold, parameter
from .blocks.version import __version__
from .diagrams import (
    Coupling,
    Diagram,
    Requirements,
    Run,
    SimulationError,
    analyse,
    check_block,
    experiments,
    fig3,
    subsystem,
)
from .fmus import Fmu, StepOptions, build, doctor, read_description
from .frequency import disk_margin, margins, place

__all__ = [
    "Block",
    "Coupling",
    "Diagram",
    "Event",
    "Fmu",
    "Input",
    "LoopwrightError",
    "Output",
    "Requirements",
    "Run",
    "SimulationError",
    "State",
    "StepOptions",
    "__version__",
    "analyse",
    "blocks",
    "build",
    "check_block",
    "diagrams",
    "disk_margin",
    "doctor",
    "experiments",
    "fig3",
    "fmus",
    "frequency",
    "hold",
    "margins",
    "parameter",
    "place",
    "read_description",
    "subsystem",
    "sweeps",
    "types",
]
