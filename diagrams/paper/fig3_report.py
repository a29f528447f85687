"""The report of a diagram of Fig. 3: the parts of any report, and the paper's."""

from __future__ import annotations

from typing import Any

from ...blocks.core import LoopwrightError
from ..frequency import mimo_disk_margin
from ..report import (
    CLOSED_LOOPS,
    DEFINITIONS,
    DISK_NUMBERS,
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
    Implementation,
    ReportKind,
    ReportPart,
    Section,
    TableForm,
    Texts,
    disk_numbers,
    disk_range,
    read_definitions,
)
from .fig3_admittance import admittance, has_admittance
from .fig3_case import Fig3Case
from .fig3_limits_tried import is_tried, limits_tried
from .fig3_poles import claims, poles_asked
from .reduced_loops import ReducedLoops

TEXTS = Texts(__package__, "limits")
SUBJECT_TEXTS = Texts(__package__, "subject")
MOTOR_FORCES = Texts(__package__, "motor_forces")

DISKS = TableForm(
    "MIMO disk margin at the motor forces",
    {"variant": "variant", "η": "eta", "ξ": "xi", "α": "disk_margin", "at": "frequency", "gains and phase": "range"},
    {name: f"{{key}}.{{place}}.{name}" for name in DISK_NUMBERS},
)


def friction_in_keys(case: Fig3Case) -> Section:
    """Return the text on keys of variants with friction."""
    return Section("subject", SUBJECT_TITLE, SUBJECT_TEXTS.paragraphs("friction"))


def has_friction(case: Fig3Case) -> bool:
    """Return whether variants with and without the plant's friction differ."""
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


def motor_forces(case: Fig3Case) -> Section | None:
    """Return the section about the loop at the motor forces, at several path points, with and without offset."""
    rows: list[dict[str, Any]] = []
    notes: list[str] = []
    for v in case.usable():
        if not (v.is_design or v.is_actual or v.implementation is Implementation.SAMPLED):
            continue
        for place, eta, xi in case.places():
            at = case.at(v, eta, xi)
            if at is None:
                continue
            try:
                disk = mimo_disk_margin(at.loop("motor_force"))
            except LoopwrightError as error:
                notes.append(f"{v.title} at {place}: {error.message}")
                continue
            facts = {"variant": v.title, "key": v.key, "place": place, "eta": f"{eta:.3f} m", "xi": f"{xi:.3f} m"}
            rows.append({**facts, **disk_numbers(disk), "range": disk_range(disk)})
    if not rows:
        return None
    text = (*MOTOR_FORCES.paragraphs("disk"), *notes)
    part = Section("motor_force", "Loops at the motor forces", text, (DISKS.fill(rows),))
    return Section("inner", "Inner loops", sections=(part,))


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
