"""Inspection, validation, examination and trial runs of FMUs."""

from .diagnosis import FmuDiagnosis, FmuTrial, FmuVerdict
from .examination import doctor
from .summary import INTERFACES, summarize
from .validation import validate

__all__ = [
    "INTERFACES",
    "FmuDiagnosis",
    "FmuTrial",
    "FmuVerdict",
    "doctor",
    "summarize",
    "validate",
]
