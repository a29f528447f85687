"""Plants of the library."""

from lazy_loader import attach_stub as _load_on_use

__getattr__, __dir__, __all__ = _load_on_use(__name__, __file__)  # the names are in __init__.pyi
