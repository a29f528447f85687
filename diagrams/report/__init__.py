"""The general design report, which knows no paper: its variants, sections, figures and pages."""

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
from .case import IN_MODEL_EXCHANGE, Basis, Case, InjectionPlan
from .figures import DOTTED, draw_admittances, fill_growth, with_drawing
from .pages import (
    DEFINITIONS,
    Plot,
    Report,
    Section,
    Table,
    TableForm,
    Texts,
    check_files,
    quantity,
    read_definitions,
    write_report,
)
from .report_parts import ReportKind, ReportPart
from .sections.loops import DISK_NUMBERS, disk_numbers, disk_range
from .sections.not_modelled import LIMITS_TITLE
from .sections.poles import POLES_TITLE, list_poles
from .sections.subject import SUBJECT_TITLE
from .stability import scatter, without_memory
from .variant import Implementation, Variant, in_s, look_of, point_of

__all__ = [
    "ANY_DIAGRAM",
    "CLOSED_LOOPS",
    "DEFINITIONS",
    "DISK_NUMBERS",
    "DOTTED",
    "INJECTION",
    "INNER_LOOPS",
    "IN_MODEL_EXCHANGE",
    "LIMITS",
    "LIMITS_TITLE",
    "MEMORY",
    "OPERATING_POINTS",
    "POLES_TITLE",
    "REMARKS",
    "SENSITIVITY",
    "STEPS",
    "SUBJECT",
    "SUBJECT_TITLE",
    "Basis",
    "Case",
    "Implementation",
    "InjectionPlan",
    "Plot",
    "Report",
    "ReportKind",
    "ReportPart",
    "Section",
    "Table",
    "TableForm",
    "Texts",
    "Variant",
    "analyse",
    "check_files",
    "disk_numbers",
    "disk_range",
    "draw_admittances",
    "fill_growth",
    "in_s",
    "list_poles",
    "look_of",
    "point_of",
    "quantity",
    "read_definitions",
    "scatter",
    "with_drawing",
    "without_memory",
    "write_report",
]
