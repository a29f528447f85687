"""Frequency and step responses measured on running diagrams."""

from .measured_response import FrequencyResponse, frequency_response
from .step_measures import Measured, measure_step
from .step_response import StepResponse, step_response

__all__ = [
    "FrequencyResponse",
    "Measured",
    "StepResponse",
    "frequency_response",
    "measure_step",
    "step_response",
]
