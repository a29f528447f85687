"""Diagrams: wiring, scheduling, simulation; linearization and margins; Fig. 3 and its experiments; the command line."""

from typing import Any as _Any

from ..blocks.public_names import load_on_use as _load_on_use
from ..fmus.exported_models import register_maker as _register_maker

__getattr__, __dir__, __all__ = _load_on_use(__name__, __file__)  # the names are in __init__.pyi


def _make_exported(model: object, **options: _Any) -> _Any:
    from .exporting import make_exported  # when something is exported

    return make_exported(model, **options)


_register_maker(_make_exported)
