"""FMUs: plants that are written as Python equations and exported, and FMUs of any tool as blocks."""

from lazy_loader import attach_stub as _load_on_use

from ..blocks import moved as _moved  # noqa: F401  gives old pickles, which name modules of this room, an error

__getattr__, __dir__, __all__ = _load_on_use(__name__, __file__)  # the names are in __init__.pyi
