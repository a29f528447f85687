"""The report of a diagram of Fig. 3: the parts of any report, and the paper's."""

from __future__ import annotations

from ..report import (
    CLOSED_LOOPS,
    DEFINITIONS,
    INJECTION,
    INNER_LOOPS,
    LIMITS,
    LIMITS_TITLE,
    MEMORY,
    OPERATING_POINTS,
    REMARKS,
    SENSITIVITY,
    STEPS,
    SUBJECT,
    SUBJECT_TITLE,
    ReportKind,
    ReportPart,
    Section,
    Texts,
    read_definitions,
)
from .fig3_admittance import admittance, has_admittance
from .fig3_case import Fig3Case
from .fig3_claims import claims
from .fig3_limits_tried import is_tried, limits_tried
from .fig3_motor_forces import motor_forces
from .fig3_poles import poles_asked
from .reduced_loops import ReducedLoops

TEXTS = Texts(__package__, "limits")
SUBJECT_TEXTS = Texts(__package__, "subject")


def friction_in_keys(case: Fig3Case) -> Section:
    """Return the text on keys of variants with friction."""
    return Section("subject", SUBJECT_TITLE, SUBJECT_TEXTS.paragraphs("friction"))


def has_friction(case: Fig3Case) -> bool:
    """Return whether variants with and without the plant's friction are told apart."""
    return case.has_friction


def reduced_not_modelled(case: Fig3Case) -> Section:
    """Return the text on what the reduced loops leave out."""
    return Section("limits", LIMITS_TITLE, TEXTS.paragraphs("reduced"))


def is_reduced(case: Fig3Case) -> bool:
    """Return whether the report has numbers of reduced loops."""
    return not {"admittance", "time_domain"}.isdisjoint(case.keys) and isinstance(case.reduced, ReducedLoops)


def friction_not_modelled(case: Fig3Case) -> Section:
    """Return the text on what the law of friction leaves out."""
    return Section("limits", LIMITS_TITLE, TEXTS.paragraphs("friction"))


FIG3 = ReportKind(
    Fig3Case,
    (
        SUBJECT,
        ReportPart("subject", friction_in_keys, has_friction),
        REMARKS,
        OPERATING_POINTS,
        CLOSED_LOOPS,
        ReportPart("poles", poles_asked),
        MEMORY,
        ReportPart("poles", claims),
        INNER_LOOPS,
        ReportPart("inner", motor_forces),
        STEPS,
        SENSITIVITY,
        ReportPart("admittance", admittance, has_admittance),
        ReportPart("time_domain", limits_tried, is_tried),
        INJECTION,
        LIMITS,
        ReportPart("limits", reduced_not_modelled, is_reduced),
        ReportPart("limits", friction_not_modelled, has_friction),
    ),
    {**DEFINITIONS, **read_definitions(__package__)},
    {"poles": "Poles asked and got", "inner": "Inner loops"},
)
"""The report of a diagram of Fig. 3."""
