"""Events in continuous time: domains of indicators, the search for changes within a step, and limits of both."""

from .domains import Domains
from .search import evaluate_many

__all__ = ["Domains", "evaluate_many"]
