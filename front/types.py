"""Classes of objects that Loopwright makes, for annotations and ``isinstance``, and enums to compare with.

A program constructs none of them: functions and methods of the other packages return them.
"""

from .blocks.public_names import load_on_use as _load_on_use

__getattr__, __dir__, __all__ = _load_on_use(__name__, __file__)  # the names are in types.pyi
