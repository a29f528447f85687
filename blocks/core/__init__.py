"""The base of all blocks: ports, signals, values, units and errors."""

from . import arithmetic, source  # operators on signals make their blocks

__all__ = ["arithmetic", "source"]
