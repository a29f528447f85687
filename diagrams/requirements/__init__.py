"""Requirements on a design, and the verdicts on its numbers."""

from .limits import SENSES, Limit, Reason, Sense, Verdict, judge, judge_interval
from .requirements import LoopLimits, Requirements, StepLimits
from .results import RequirementResult, Review
from .toml_file import STUDIES, TomlFile, read_requirements

__all__ = [
    "SENSES",
    "STUDIES",
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
    "judge",
    "judge_interval",
    "read_requirements",
]
