"""Events in continuous time: domains of indicators, the search for changes within a step, and limits of both."""

from .domains import Domains

__all__ = ["Domains"]
