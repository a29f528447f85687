"""Blocks: what a block is, and the library.

A block's equations are written once, as NumPy-style functions of (t, x, u), and run, traced, differentiated and
compiled from there. Everything here is public; nothing here imports the rooms above.
"""

from ._algebra import Gain, Product, Saturation, Sum
from ._block import Block
from ._compliance import AdmittanceFilter, ErrorDynamics
from ._discrete import Encoder, ForceSensor, UnitDelay
from ._discretization import hold
from ._environment import HandForce, PathSpring
from ._errors import (
    AlgebraicLoopError,
    CompilerError,
    ConfirmationError,
    DefinitionError,
    DoubleDriveError,
    DuplicateNameError,
    FmuError,
    FmuFileError,
    FmuRuntimeError,
    GuardError,
    LoopwrightError,
    NonFiniteError,
    OptionError,
    ParameterError,
    PathDomainError,
    SampleTimeError,
    ShapeError,
    SimulationError,
    TraceError,
    UnitError,
    UnknownNameError,
    UnwiredInputError,
    WiringError,
)
from ._mechanics import PlanarModel
from ._path_following import FeedbackLinearization, ForceProjection, PathProjection, PathTracking, TransverseTransform
from ._paths import Circle, CubicSpline, Ellipse, Frame, Line, Path
from ._ports import Event, Input, Output, State
from ._signals import Call, Signal
from ._sources import Constant, Pulse, Reference, Sine, SmoothStep, Step
from ._units import Unit, parse_unit
from ._values import Array, Value, parameter

__all__ = [
    "AdmittanceFilter",
    "AlgebraicLoopError",
    "Array",
    "Block",
    "Call",
    "Circle",
    "CompilerError",
    "ConfirmationError",
    "Constant",
    "CubicSpline",
    "DefinitionError",
    "DoubleDriveError",
    "DuplicateNameError",
    "Ellipse",
    "Encoder",
    "ErrorDynamics",
    "Event",
    "FeedbackLinearization",
    "FmuError",
    "FmuFileError",
    "FmuRuntimeError",
    "ForceProjection",
    "ForceSensor",
    "Frame",
    "Gain",
    "GuardError",
    "HandForce",
    "Input",
    "Line",
    "LoopwrightError",
    "NonFiniteError",
    "OptionError",
    "Output",
    "ParameterError",
    "Path",
    "PathDomainError",
    "PathProjection",
    "PathSpring",
    "PathTracking",
    "PlanarModel",
    "Product",
    "Pulse",
    "Reference",
    "SampleTimeError",
    "Saturation",
    "ShapeError",
    "Signal",
    "SimulationError",
    "Sine",
    "SmoothStep",
    "State",
    "Step",
    "Sum",
    "TraceError",
    "TransverseTransform",
    "Unit",
    "UnitDelay",
    "UnitError",
    "UnknownNameError",
    "UnwiredInputError",
    "Value",
    "WiringError",
    "hold",
    "parameter",
    "parse_unit",
]
