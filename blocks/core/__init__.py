"""The base of all blocks: ports, signals, values, units and errors."""

from . import arithmetic, moved, source  # operators on signals make their blocks

__all__ = ["arithmetic", "moved", "source"]

moved.explain_moved_modules()
