"""Blocks: what a block is, and the library.

A block's equations are written once, as NumPy-style functions of (t, x, u), and run, traced, differentiated and
compiled from there. Everything here is public; nothing here imports the rooms above.
"""

from ._algebra import DeadZone, Gain, Maximum, Minimum, Product, Saturation, Sum
from ._block import Block
from ._compliance import AdmittanceFilter, ErrorDynamics
from ._contact import HandProfile, SpringDamper, Wall
from ._delays import Delay, PadeDelay, TransportDelay
from ._discrete import Encoder, ForceSensor, Hold, UnitDelay
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
from ._integrators import FilteredDerivative, Integrator, LimitedIntegrator, ResettableIntegrator
from ._linear import DiscreteStateSpace, DiscreteTransferFunction, StateSpace, TransferFunction
from ._logic import And, Compare, Counter, EdgeDetector, Latch, Not, Or, Switch
from ._lookup_blocks import Lookup1D, Lookup2D
from ._mechanics import PlanarModel
from ._nonlinear import Backlash, Quantizer, RateLimiter, Relay
from ._opaque import Function, PythonFunction
from ._path_following import FeedbackLinearization, ForceProjection, PathProjection, PathTracking, TransverseTransform
from ._paths import Circle, CubicSpline, Ellipse, Frame, Line, Path
from ._pid import PID
from ._ports import Event, Input, Output, State
from ._requirements import Requirement, StopCondition
from ._sampled_linear import FIR, IIR, DiscreteIntegrator, MovingAverage
from ._signal_sources import BandLimitedNoise, Chirp, Clock, PiecewiseLinear, PulseTrain, Ramp, Recorded
from ._signals import Call, Signal
from ._sources import Constant, Pulse, Reference, Sine, SmoothStep, Step
from ._state_machine import StateMachine
from ._units import Unit, parse_unit
from ._values import Array, Value, parameter
from ._zero_pole import DiscreteZeroPoleGain, ZeroPoleGain

__all__ = [  # noqa: RUF022 - as sorted() does, acronyms too
    "AdmittanceFilter",
    "AlgebraicLoopError",
    "And",
    "Array",
    "Backlash",
    "BandLimitedNoise",
    "Block",
    "Call",
    "Chirp",
    "Circle",
    "Clock",
    "Compare",
    "CompilerError",
    "ConfirmationError",
    "Constant",
    "Counter",
    "CubicSpline",
    "DeadZone",
    "DefinitionError",
    "Delay",
    "DiscreteIntegrator",
    "DiscreteStateSpace",
    "DiscreteTransferFunction",
    "DiscreteZeroPoleGain",
    "DoubleDriveError",
    "DuplicateNameError",
    "EdgeDetector",
    "Ellipse",
    "Encoder",
    "ErrorDynamics",
    "Event",
    "FIR",
    "FeedbackLinearization",
    "FilteredDerivative",
    "FmuError",
    "FmuFileError",
    "FmuRuntimeError",
    "ForceProjection",
    "ForceSensor",
    "Frame",
    "Function",
    "Gain",
    "GuardError",
    "HandForce",
    "HandProfile",
    "Hold",
    "IIR",
    "Input",
    "Integrator",
    "Latch",
    "LimitedIntegrator",
    "Line",
    "Lookup1D",
    "Lookup2D",
    "LoopwrightError",
    "Maximum",
    "Minimum",
    "MovingAverage",
    "NonFiniteError",
    "Not",
    "OptionError",
    "Or",
    "Output",
    "PID",
    "PadeDelay",
    "ParameterError",
    "Path",
    "PathDomainError",
    "PathProjection",
    "PathSpring",
    "PathTracking",
    "PiecewiseLinear",
    "PlanarModel",
    "Product",
    "Pulse",
    "PulseTrain",
    "PythonFunction",
    "Quantizer",
    "Ramp",
    "RateLimiter",
    "Recorded",
    "Reference",
    "Relay",
    "Requirement",
    "ResettableIntegrator",
    "SampleTimeError",
    "Saturation",
    "ShapeError",
    "Signal",
    "SimulationError",
    "Sine",
    "SmoothStep",
    "SpringDamper",
    "State",
    "StateMachine",
    "StateSpace",
    "Step",
    "StopCondition",
    "Sum",
    "Switch",
    "TraceError",
    "TransferFunction",
    "TransportDelay",
    "TransverseTransform",
    "Unit",
    "UnitDelay",
    "UnitError",
    "UnknownNameError",
    "UnwiredInputError",
    "Value",
    "Wall",
    "WiringError",
    "ZeroPoleGain",
    "hold",
    "parameter",
    "parse_unit",
]
