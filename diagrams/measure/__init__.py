"""Frequency responses measured on a running diagram."""

from .measured_response import FrequencyResponse, frequency_response

__all__ = [
    "FrequencyResponse",
    "frequency_response",
]
