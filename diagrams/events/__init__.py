"""Events in continuous time: domains of indicators, the search for changes within a step, and limits of both."""

from .domains import Domains
from .many import ManyInstants, evaluate_many
from .sliding import Sliding

__all__ = ["Domains", "ManyInstants", "Sliding", "evaluate_many"]
