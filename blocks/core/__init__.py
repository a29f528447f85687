"""The base of all blocks: ports, signals, values, units and errors."""

from . import arithmetic, moved, source  # arithmetic and source register the blocks that operators make

__all__ = ["arithmetic", "moved", "source"]

moved.explain_moved_modules()
