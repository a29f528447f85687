"""The base of all blocks: ports, signals, values, units and errors."""

from . import arithmetic, source  # operators on signals make their blocks
from .moved import explain_moved_modules

__all__ = ["arithmetic", "explain_moved_modules", "source"]
