"""Choices among numbers that are equal but for rounding: they fall alike on every machine."""

from __future__ import annotations

from typing import Any

import numpy as np

EQUAL = 1e-9
"""Relative difference below which numbers count as equal."""


def first_largest(values: Any) -> int:
    """Return the place of the largest number, the first of those that equal it but for rounding; NaN never is.

    Parameters
    ----------
    values : array, shape (n,)
        Numbers, not all NaN.
    """
    row = np.asarray(values, dtype=float)
    largest = np.nanmax(row)
    return int(np.argmax(row >= largest - EQUAL * abs(largest)))


def order_key(value: float) -> float:
    """Return a number without its last digits, so that a second key orders those that are equal but for rounding."""
    return float(f"{value:.9e}")
