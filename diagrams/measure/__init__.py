"""Frequency and step responses measured on running diagrams."""

from .measured_response import FrequencyResponse, frequency_response
from .quanta import (
    LEAST,
    LEAST_SINE,
    Converter,
    Quantum,
    columns_of,
    find_converters,
    find_least_sine,
    find_least_step,
    find_quantum,
    find_rest,
    remaining_oscillation,
)
from .step_measures import ExpectedStep, Measured, is_at_rest, measure_step
from .step_response import DivergenceError, StepResponse, step_response

__all__ = [
    "LEAST",
    "LEAST_SINE",
    "Converter",
    "DivergenceError",
    "ExpectedStep",
    "FrequencyResponse",
    "Measured",
    "Quantum",
    "StepResponse",
    "columns_of",
    "find_converters",
    "find_least_sine",
    "find_least_step",
    "find_quantum",
    "find_rest",
    "frequency_response",
    "is_at_rest",
    "measure_step",
    "remaining_oscillation",
    "step_response",
]
