"""Blocks: the base of all blocks, and the library.

A block's equations are written once, as NumPy-style functions of (t, x, u); from these they are run, traced,
differentiated and compiled. Everything exported here is public; nothing here imports the packages above.
"""

from . import moved as _moved
from . import public_names as _public_names

_moved.explain_moved_modules()
_public_names.explain_missing_names()
__getattr__, __dir__, __all__ = _public_names.load_on_use(__name__, __file__)  # the names are in __init__.pyi
