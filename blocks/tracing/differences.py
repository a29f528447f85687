"""Slopes by central differences of fourth order."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

STEP = float(np.cbrt(np.finfo(float).eps))
"""Step of a difference, relative to the size of what moves: rounding changes the slope by 4e-11 of the value."""


def extrapolate(near: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Return a slope from difference quotients over h and over 2 h, without their error of second order."""
    return np.asarray((4.0 * near - far) / 3.0)


def differentiate(values: Callable[[float], Sequence[np.ndarray]], at: float, size: float) -> list[np.ndarray]:
    """Return the slopes of vectors by one number, of which they are a function; ``size`` is that of the number."""

    def quotients(step: float) -> list[np.ndarray]:
        high, low = at + step, at - step
        return [(above - below) / (high - low) for above, below in zip(values(high), values(low), strict=True)]

    near, far = quotients(STEP * size), quotients(2.0 * STEP * size)
    return [extrapolate(a, b) for a, b in zip(near, far, strict=True)]
