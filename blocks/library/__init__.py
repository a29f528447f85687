"""Blocks of everybody's diagrams."""

from .algebra import DeadZone, Maximum, Minimum, Power, Saturation
from .contact import HandProfile, SpringDamper, Wall
from .delays import Delay, PadeDelay, TransportDelay
from .filters import FIR, IIR, DiscreteIntegrator, MovingAverage
from .functions import Function, PythonFunction
from .generators import BandLimitedNoise, Chirp, Clock, PiecewiseLinear, PulseTrain, Ramp, Recorded
from .integrators import FilteredDerivative, Integrator, LimitedIntegrator, ResettableIntegrator
from .linear import DiscreteStateSpace, DiscreteTransferFunction, StateSpace, TransferFunction
from .logic import And, Compare, Counter, EdgeDetector, Latch, Not, Or, Switch
from .lookup import Lookup1D, Lookup2D
from .nonlinear import Backlash, Quantizer, RateLimiter, Relay
from .pid import PID
from .piecewise_functions import jet, piecewise, wrap
from .python_control import FixedSampleTime
from .requirements import Requirement, StopCondition
from .sampled import Encoder, ForceSensor, Hold, UnitDelay
from .sources import Pulse, Reference, Sine, SmoothStep, Step
from .state_machine import StateMachine
from .unit_conversion import UnitConversion
from .zero_pole import DiscreteZeroPoleGain, ZeroPoleGain

__all__ = [
    "FIR",
    "IIR",
    "PID",
    "And",
    "Backlash",
    "BandLimitedNoise",
    "Chirp",
    "Clock",
    "Compare",
    "Counter",
    "DeadZone",
    "Delay",
    "DiscreteIntegrator",
    "DiscreteStateSpace",
    "DiscreteTransferFunction",
    "DiscreteZeroPoleGain",
    "EdgeDetector",
    "Encoder",
    "FilteredDerivative",
    "FixedSampleTime",
    "ForceSensor",
    "Function",
    "HandProfile",
    "Hold",
    "Integrator",
    "Latch",
    "LimitedIntegrator",
    "Lookup1D",
    "Lookup2D",
    "Maximum",
    "Minimum",
    "MovingAverage",
    "Not",
    "Or",
    "PadeDelay",
    "PiecewiseLinear",
    "Power",
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
    "Saturation",
    "Sine",
    "SmoothStep",
    "SpringDamper",
    "StateMachine",
    "StateSpace",
    "Step",
    "StopCondition",
    "Switch",
    "TransferFunction",
    "TransportDelay",
    "UnitConversion",
    "UnitDelay",
    "Wall",
    "ZeroPoleGain",
    "jet",
    "piecewise",
    "wrap",
]
