"""The general design report."""

from ..report_figures import with_drawing
from .analysis import (
    ANY_DIAGRAM,
    CLOSED_LOOPS,
    INJECTION,
    INNER_LOOPS,
    LIMITS,
    MEMORY,
    OPERATING_POINTS,
    REMARKS,
    SENSITIVITY,
    STEPS,
    SUBJECT,
    analyse,
)
from .case import OUTSIDE, Basis, Case, InjectionPlan
from .disks import disk_numbers, disk_range
from .parts import MakesSections, ReportKind, ReportPart
from .points import point_of
from .section_contact import SIGN_COLUMNS, sign_of_admittance
from .section_limits import LIMITS_TITLE
from .section_poles import POLES_TITLE, list_poles
from .section_subject import SUBJECT_TITLE
from .stability import scatter, without_memory
from .variant import Implementation, Variant, in_s, look_of

__all__ = [
    "ANY_DIAGRAM",
    "CLOSED_LOOPS",
    "INJECTION",
    "INNER_LOOPS",
    "LIMITS",
    "LIMITS_TITLE",
    "MEMORY",
    "OPERATING_POINTS",
    "OUTSIDE",
    "POLES_TITLE",
    "REMARKS",
    "SENSITIVITY",
    "SIGN_COLUMNS",
    "STEPS",
    "SUBJECT",
    "SUBJECT_TITLE",
    "Basis",
    "Case",
    "Implementation",
    "InjectionPlan",
    "MakesSections",
    "ReportKind",
    "ReportPart",
    "Variant",
    "analyse",
    "disk_numbers",
    "disk_range",
    "in_s",
    "list_poles",
    "look_of",
    "point_of",
    "scatter",
    "sign_of_admittance",
    "with_drawing",
    "without_memory",
]
