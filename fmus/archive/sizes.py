"""Sizes of arrays that depend on structural parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np


def resize(model: Any, sizes: Mapping[str, int]) -> None:
    """Give structural parameters other values, and arrays the sizes that follow (FMI 3.0, 2.4.7.5).

    FMPy's reading of the description is changed. Start values for each element that don't fit any more are dropped:
    only the FMU knows them.
    """
    if not sizes:
        return
    for v in model.modelVariables:
        if v.name in sizes:
            v.start = str(sizes[v.name])
    for v in model.modelVariables:
        if not any(d.variable is not None and d.variable.name in sizes for d in v.dimensions or ()):
            continue
        v.shape = tuple(int(d.start if d.variable is None else d.variable.start) for d in v.dimensions)
        given = v.start.split() if isinstance(v.start, str) else None
        if given and len(set(given)) == 1:
            v.start = given[0]  # for each element
        elif given and len(given) != np.prod(v.shape, dtype=int):
            v.start = None
