"""Blocks of everybody's diagrams."""

from .algebra import DeadZone, Maximum, Minimum, Power, Saturation
from .contact import HandProfile, SpringDamper, Wall
from .delays import Delay, PadeDelay, TransportDelay, VariableDelay
from .estimators import DiscreteObserver, Observer, StateFeedback
from .filters import FIR, IIR, MovingAverage
from .functions import Function, PythonFunction
from .generators import Chirp, Clock, PulseTrain, Ramp, Sawtooth, Triangle
from .integrators import DiscreteIntegrator, FilteredDerivative, Integrator, LimitedIntegrator, ResettableIntegrator
from .linear import DiscreteStateSpace, DiscreteTransferFunction, StateSpace, TransferFunction
from .logic import And, Compare, Counter, EdgeDetector, Latch, Not, Or, Switch
from .lookup import Lookup1D, Lookup2D
from .noise import BandLimitedNoise
from .nonlinear import Backlash, Quantizer, RateLimiter, Relay
from .pid import PID
from .piecewise_functions import jet, piecewise, wrap
from .python_control import FixedSampleTime
from .requirements import Requirement, StopCondition
from .sampled import Encoder, ForceSensor, Hold, UnitDelay
from .sources import Pulse, Reference, Sine, SmoothStep, Step
from .standard_elements import PT1, PT2, Butterworth, LeadLag, Notch
from .state_machine import StateMachine
from .tables_over_time import PiecewiseLinear, Recorded
from .unit_conversion import UnitConversion
from .zero_pole import DiscreteZeroPoleGain, ZeroPoleGain

__all__ = [
    "FIR",
    "IIR",
    "PID",
    "PT1",
    "PT2",
    "And",
    "Backlash",
    "BandLimitedNoise",
    "Butterworth",
    "Chirp",
    "Clock",
    "Compare",
    "Counter",
    "DeadZone",
    "Delay",
    "DiscreteIntegrator",
    "DiscreteObserver",
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
    "LeadLag",
    "LimitedIntegrator",
    "Lookup1D",
    "Lookup2D",
    "Maximum",
    "Minimum",
    "MovingAverage",
    "Not",
    "Notch",
    "Observer",
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
    "Sawtooth",
    "Sine",
    "SmoothStep",
    "SpringDamper",
    "StateFeedback",
    "StateMachine",
    "StateSpace",
    "Step",
    "StopCondition",
    "Switch",
    "TransferFunction",
    "TransportDelay",
    "Triangle",
    "UnitConversion",
    "UnitDelay",
    "VariableDelay",
    "Wall",
    "ZeroPoleGain",
    "jet",
    "piecewise",
    "wrap",
]
