"""FMUs: plants that are written as Python equations and exported, and FMUs of any tool as blocks."""

from ..blocks.public_names import load_on_use as _load_on_use

__getattr__, __dir__, __all__ = _load_on_use(__name__, __file__)  # the names are in __init__.pyi
