"""Inspection, validation and trial runs of FMUs."""

from .summary import INTERFACES, summarize
from .validation import validate

__all__ = [
    "INTERFACES",
    "summarize",
    "validate",
]
