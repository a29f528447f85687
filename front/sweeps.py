"""Sweeps: samples of parameters, and what is kept of each run (`Diagram.sweep`, `Diagram.worst_case`)."""

from .blocks.public_names import load_on_use as _load_on_use

__getattr__, __dir__, __all__ = _load_on_use(__name__, __file__)  # the names are in sweeps.pyi
