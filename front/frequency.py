"""Functions of loops and of linear models, and what they return: margins, disk margins, Nyquist counts, pole placement.

A loop is a system of python-control, `Diagram.linearize` gives it by ``model.loop("wire")``.
"""

from .blocks.public_names import load_on_use as _load_on_use

__getattr__, __dir__, __all__ = _load_on_use(__name__, __file__)  # the names are in frequency.pyi
