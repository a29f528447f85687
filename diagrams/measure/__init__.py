"""Frequency and step responses measured on running diagrams."""

from .measured_response import FrequencyResponse, frequency_response
from .step_measures import ExpectedStep, Measured, is_at_rest, measure_step
from .step_response import StepResponse, step_response

__all__ = [
    "ExpectedStep",
    "FrequencyResponse",
    "Measured",
    "StepResponse",
    "frequency_response",
    "is_at_rest",
    "measure_step",
    "step_response",
]
