"""One evaluation of a block in model exchange: the quantities that are wanted, and the vectors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Wanted(NamedTuple):
    """Quantities that are wanted of a block, in the order in which they are returned, flat.

    Attributes
    ----------
    outputs : tuple of str
        Names of output ports.
    rates : bool
        Whether the derivatives of all states follow.
    indicators : bool
        Whether the indicators of all events follow.
    """

    outputs: tuple[str, ...] = ()
    rates: bool = False
    indicators: bool = False


class EvaluationVectors(NamedTuple):
    """Vectors that an evaluation reads, and the one that it writes, where they are; all of float64.

    Attributes
    ----------
    t : ndarray
        Time in s, shape (1,).
    x, u : ndarray
        The block's states and inputs, flat.
    into : ndarray
        The result, flat.
    """

    t: np.ndarray
    x: np.ndarray
    u: np.ndarray
    into: np.ndarray
