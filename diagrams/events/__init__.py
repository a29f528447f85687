"""Events in continuous time: the domains of their indicators, and errors where events pile up."""

from .domains import LATEST, Domains
from .event_errors import RECENT

__all__ = ["LATEST", "RECENT", "Domains"]
