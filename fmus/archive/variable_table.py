"""The table of an FMU's variables. Its texts are those of others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ...blocks.core import Grid
from .variables import FmuVariable


def variable_grid(title: str, variables: Mapping[str, FmuVariable], started: Mapping[str, Any]) -> Grid:
    """Return a table of variables by the names of their ports; ``started`` has start values that replace their own."""
    rows = tuple(
        (
            name,
            "" if name == v.name else v.name,
            _start(started.get(v.name, v.start)),
            "" if v.unit in (None, "1") else v.unit,
            "" if v.type == "Float64" else v.type,
            " × ".join(map(str, v.shape)),
            v.description,
        )
        for name, v in variables.items()
    )
    return Grid(title, ("name", "in the FMU", "start", "unit", "type", "shape", "description"), rows)


def _start(value: Any) -> Any:
    """Return a start value: a number as such, where its array has no dimensions."""
    return value.item() if isinstance(value, np.ndarray | np.generic) and np.ndim(value) == 0 else value
