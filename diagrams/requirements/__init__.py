"""Requirements on a design, and the verdicts on its numbers."""

from .contact_limits import ContactLimits, read_contact_limits
from .explanations import UNREAD, explain
from .number_limits import SENSES, STEP_UNITS, Limit, Reason, Sense, Verdict, is_doubtful, judge, judge_interval
from .requirements import LoopLimits, Requirements, StepLimits
from .results import RequirementResult, Review
from .toml_file import REQUIRED, STUDIES, TomlFile, read_requirements

__all__ = [
    "REQUIRED",
    "SENSES",
    "STEP_UNITS",
    "STUDIES",
    "UNREAD",
    "ContactLimits",
    "Limit",
    "LoopLimits",
    "Reason",
    "RequirementResult",
    "Requirements",
    "Review",
    "Sense",
    "StepLimits",
    "TomlFile",
    "Verdict",
    "explain",
    "is_doubtful",
    "judge",
    "judge_interval",
    "read_contact_limits",
    "read_requirements",
]
