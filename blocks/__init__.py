"""Blocks: the base of all blocks, and the library.

A block's equations are written once, as NumPy-style functions of (t, x, u); from these they are run, traced,
differentiated and compiled. Everything exported here is public; nothing here imports the rooms above.
"""

from .core.arithmetic import Gain, Product, Sum
from .core.block import Block
from .core.errors import (
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
from .core.ports import Event, Input, Output, State
from .core.signals import Call, Signal
from .core.source import Constant
from .core.units import Unit, parse_unit
from .core.values import Array, Value, parameter
from .library.algebra import DeadZone, Maximum, Minimum, Saturation
from .library.contact import HandProfile, SpringDamper, Wall
from .library.delays import Delay, PadeDelay, TransportDelay
from .library.filters import FIR, IIR, DiscreteIntegrator, MovingAverage
from .library.functions import Function, PythonFunction
from .library.generators import BandLimitedNoise, Chirp, Clock, PiecewiseLinear, PulseTrain, Ramp, Recorded
from .library.integrators import FilteredDerivative, Integrator, LimitedIntegrator, ResettableIntegrator
from .library.linear import DiscreteStateSpace, DiscreteTransferFunction, StateSpace, TransferFunction
from .library.logic import And, Compare, Counter, EdgeDetector, Latch, Not, Or, Switch
from .library.lookup import Lookup1D, Lookup2D
from .library.nonlinear import Backlash, Quantizer, RateLimiter, Relay
from .library.pid import PID
from .library.requirements import Requirement, StopCondition
from .library.sampled import Encoder, ForceSensor, Hold, UnitDelay
from .library.sources import Pulse, Reference, Sine, SmoothStep, Step
from .library.state_machine import StateMachine
from .library.zero_pole import DiscreteZeroPoleGain, ZeroPoleGain
from .path_following.compliance import AdmittanceFilter, ErrorDynamics
from .path_following.environment import HandForce, PathSpring
from .path_following.planar_model import PlanarModel
from .path_following.transverse import (
    FeedbackLinearization,
    ForceProjection,
    PathProjection,
    PathTracking,
    TransverseTransform,
)
from .paths import Circle, CubicSpline, Ellipse, Frame, Line, Path
from .tracing.discretization import hold

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
