"""Requirements on a design, and the verdicts on its numbers."""

from .contact_limits import ContactLimits, read_contact_limits
from .requirements import REQUIREMENTS, Requirements, StepLimits, write_requirements
from .results import RequirementResult, StepSize, explain
from .toml_file import REQUIRED, STUDIES, TomlFile, read_requirements
from .verdict_table import COLUMNS, DIGITS, MOST_REQUIREMENTS, NOTHING, Review, by_loop, rank, reason_in_table, row_of
from .verdicts import SENSES, STEP_UNITS, Limit, Reason, Sense, Verdict, is_doubtful, judge, judge_interval

__all__ = [
    "COLUMNS",
    "DIGITS",
    "MOST_REQUIREMENTS",
    "NOTHING",
    "REQUIRED",
    "REQUIREMENTS",
    "SENSES",
    "STEP_UNITS",
    "STUDIES",
    "ContactLimits",
    "Limit",
    "Reason",
    "RequirementResult",
    "Requirements",
    "Review",
    "Sense",
    "StepLimits",
    "StepSize",
    "TomlFile",
    "Verdict",
    "by_loop",
    "explain",
    "is_doubtful",
    "judge",
    "judge_interval",
    "rank",
    "read_contact_limits",
    "read_requirements",
    "reason_in_table",
    "row_of",
    "write_requirements",
]
