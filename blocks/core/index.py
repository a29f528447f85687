"""Indices of signals, as Python's integers."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np

from .errors import WiringError


def as_index(index: Any, port: str) -> int | slice:
    """Return an index of Python's integers, so that NumPy's integers wire and compare alike."""

    def integer(value: Any) -> int:
        if isinstance(value, bool | np.bool_):
            raise TypeError
        return operator.index(value)

    try:
        if not isinstance(index, slice):
            return integer(index)
        return slice(*(None if i is None else integer(i) for i in (index.start, index.stop, index.step)))
    except TypeError:
        raise WiringError(
            f"found the index {index!r}; expected an integer or a slice of integers, as in y[0] or y[:2].", port=port
        ) from None
