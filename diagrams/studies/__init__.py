"""Studies of a design's margins over its parameters: sensitivities, worst cases."""

from .cases import CaseOrigin, CaseState, StudyCase
from .confirmed_cases import ConfirmationKind, RunConfirmation
from .contact_task import ContactTask
from .loop_places import LoopPlace, cut_places, find_places, is_zero, words_of
from .sensitivity import (
    Sensitivities,
    Sensitivity,
    confirm_parameter,
    confirm_sensitivity,
    find_sensitivities,
    sensitivities_of,
)
from .worst_case import WorstCase, find_worst_case
from .worst_case_plot import plot_cases
from .worst_case_task import WorstCaseTask

__all__ = [
    "CaseOrigin",
    "CaseState",
    "ConfirmationKind",
    "ContactTask",
    "LoopPlace",
    "RunConfirmation",
    "Sensitivities",
    "Sensitivity",
    "StudyCase",
    "WorstCase",
    "WorstCaseTask",
    "confirm_parameter",
    "confirm_sensitivity",
    "cut_places",
    "find_places",
    "find_sensitivities",
    "find_worst_case",
    "is_zero",
    "plot_cases",
    "sensitivities_of",
    "words_of",
]
