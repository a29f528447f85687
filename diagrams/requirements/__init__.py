"""Requirements on a design, and the verdicts on its numbers."""

from .limits import Limit, Reason, Verdict, judge, judge_interval
from .requirements import LoopLimits, Requirements, StepLimits
from .results import RequirementResult, Review
from .toml_file import read_requirements

__all__ = [
    "Limit",
    "LoopLimits",
    "Reason",
    "RequirementResult",
    "Requirements",
    "Review",
    "StepLimits",
    "Verdict",
    "judge",
    "judge_interval",
    "read_requirements",
]
