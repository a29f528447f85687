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
from .step_response import DivergenceError, StepResponse, step_response

__all__ = [
    "LEAST",
    "LEAST_SINE",
    "Converter",
    "DivergenceError",
    "FrequencyResponse",
    "Quantum",
    "StepResponse",
    "columns_of",
    "find_converters",
    "find_least_sine",
    "find_least_step",
    "find_quantum",
    "find_rest",
    "frequency_response",
    "remaining_oscillation",
    "step_response",
]
