"""Blocks: the base of all blocks, and the library.

A block's equations are written once, as NumPy-style functions of (t, x, u); from these they are run, traced,
differentiated and compiled. Everything exported here is public; nothing here imports the rooms above.
"""

from lazy_loader import attach_stub as _load_on_use

from . import moved as _moved

__getattr__, __dir__, __all__ = _load_on_use(__name__, __file__)  # the names are in __init__.pyi
_moved.explain_moved_modules()
